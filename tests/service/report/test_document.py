"""A report as PDF, page, CSV and JSON: words stay words, only fonts of the typesetter, missing numbers are named, pictures stand alone."""

import csv
import io
import json
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET

import numpy as np
import pypdf
import pytest

from abbe.service.rendering import document_page
from abbe.service.rendering.document import DECISION_RULE, Document, Instrument, PictureBlock, ReportFigure, Section, TextTable
from abbe.service.rendering.document_data import document_csv, document_json
from abbe.service.rendering.document_page import NO_FONT, document_html, document_pdf, standalone
from abbe.service.rendering.model import PolarTrace
from abbe.service.rendering.plots.curves import PositioningCurves, positioning_plot
from abbe.service.rendering.plots.polar import polar_plot
from abbe.service.report.report_parts import Rules, judged, verdict_of

HOSTILE = '#import "@preview/x:1.0.0" *bold* $x$ </td><script>alert(1)</script> \\ "quoted" {{ 7*7 }} [a] <b> @ref // = Title'


def document(**more) -> Document:
    figures = [
        ReportFigure("ISO 230-2", "E", HOSTILE, 12.3456, 0.25, "µm", "ISO 230-2", 20.0, "pass"),
        ReportFigure("ISO 230-2", "R", "without repeats", None, None, "µm"),
        ReportFigure("ISO 230-2", "=cmd()", "not a formula", float("nan"), float("nan"), "µm"),
    ]
    words = {
        "kind": "campaign", "title": "Campaign a", "about": {"Machine": HOSTILE},
        "verdict": ("open", "Cannot tell", "x"), "figures": figures,
        "instruments": [Instrument("laser", "valid to 2027-01-01", HOSTILE)], "conditions": {"Air": "20 °C"}, "not_observable": [HOSTILE],
        "remarks": [HOSTILE, "a\x00b\x1bc"], "provenance": {"Data (SHA-256)": "0123456789abcdef" * 4}, "statements": [HOSTILE],
        "appendix": [Section("T", [TextTable(("A", "B"), [(HOSTILE, "1")])])],
    }  # fmt: skip
    return Document(**(words | more))


def pdf_text(made: bytes) -> str:
    return "".join("".join(page.extract_text() for page in pypdf.PdfReader(io.BytesIO(made)).pages).split())


def test_hostile_words_stay_words_on_page_and_paper():
    page, text = document_html(document()), pdf_text(document_pdf(document()))
    assert "<script>" not in page
    assert "49" not in page
    assert text.count("".join(HOSTILE.split())) >= 6
    assert "a\ufffdb\ufffdc" in page


def test_the_pdf_brings_its_own_fonts_has_tags_and_no_link():
    reader = pypdf.PdfReader(io.BytesIO(document_pdf(document(appendix=[Section("P", [PictureBlock("circle", [polar()])])]))))
    fonts = {str(f["/BaseFont"]).split("+")[-1] for p in reader.pages for f in (v.get_object() for v in p["/Resources"]["/Font"].values())}
    assert fonts
    assert all(f.startswith("Libertinus") for f in fonts)
    root = reader.trailer["/Root"]
    assert root["/MarkInfo"]["/Marked"]
    assert "circle" in json.dumps([str(e) for e in alternatives(root["/StructTreeRoot"])])
    assert reader.metadata.title == "Campaign a"
    assert all("/Annots" not in p for p in reader.pages)


def test_a_dated_report_is_an_archivable_accessible_pdf_that_others_find_whole(tmp_path, require):
    require("qpdf", shutil.which("qpdf") is not None, "qpdf is not installed")
    made = document_pdf(document(days=("2026-11-27", "2026-11-28"), appendix=[Section("P", [PictureBlock("circle", [polar()])])]))
    (tmp_path / "report.pdf").write_bytes(made)
    found = subprocess.run(["qpdf", "--check", tmp_path / "report.pdf"], capture_output=True, text=True, check=False)
    assert (found.returncode, found.stderr) == (0, ""), found.stdout
    reader = pypdf.PdfReader(io.BytesIO(made))
    assert declared(reader) == {"pdfaid:part": "2", "pdfaid:conformance": "A", "pdfuaid:part": "1"}
    assert reader.metadata.creation_date.date().isoformat() == "2026-11-28"
    root = reader.trailer["/Root"]
    assert [str(one["/S"]) for one in root["/OutputIntents"]] == ["/GTS_PDFA1"]
    assert not {"/AA", "/OpenAction", "/AcroForm", "/JavaScript"} & (set(root) | set(root.get("/Names", {})))
    fonts = [font.get_object() for page in reader.pages for font in page["/Resources"]["/Font"].values()]
    assert all(
        "/FontFile3" in of["/FontDescriptor"] or "/FontFile2" in of["/FontDescriptor"] for f in fonts for of in f["/DescendantFonts"]
    )
    assert all("/ToUnicode" in f for f in fonts)


def test_a_report_without_a_day_is_accessible():
    assert declared(pypdf.PdfReader(io.BytesIO(document_pdf(document())))) == {"pdfuaid:part": "1"}


@pytest.mark.parametrize("letter", ["基準", "👍", "\ue000"])
def test_a_letter_of_no_font_is_no_standard_and_the_report_says_so(monkeypatch, letter):
    monkeypatch.setattr(document_page, "FONTS", ())
    monkeypatch.delenv("ABBE_FONTS", raising=False)
    made = document_pdf(document(remarks=[letter], days=("2026-11-27", "2026-11-28")))
    assert declared(pypdf.PdfReader(io.BytesIO(made))) == {}
    assert "ThisPDFisneitherPDF/A(forarchives)norPDF/UA(accessible):PDF/A-2a" in pdf_text(made)


def test_a_report_that_is_printed_on_another_day_is_the_same():
    days = ("2026-11-27", "2026-11-28")
    assert len({document_pdf(document(days=days, issued=day)) for day in ("2026-11-28", "2027-03-01")}) == 1
    assert len({document_pdf(document(issued=day)) for day in ("2026-11-28", "2027-03-01")}) == 1


def declared(reader: pypdf.PdfReader) -> dict[str, str]:
    """The standards of which a PDF says that it keeps them."""
    metadata = reader.trailer["/Root"]["/Metadata"].get_object().get_data().decode()
    return dict(re.findall(r"<(pdfu?aid:(?:part|conformance))>(\w+)<", metadata))


def alternatives(node) -> list[str]:
    """Texts that stand for pictures, of the whole tree of tags."""
    node = node.get_object() if hasattr(node, "get_object") else node
    if isinstance(node, list):
        return [a for child in node for a in alternatives(child)]
    if not isinstance(node, dict):
        return []
    own = [str(node["/Alt"])] if "/Alt" in node else []
    return own + (alternatives(node["/K"]) if "/K" in node else [])


def polar() -> str:
    angle = np.linspace(0.0, 360.0, 90)
    return polar_plot([PolarTrace("c1", angle, np.sin(angle))])


def test_a_picture_that_stands_alone_names_its_colours_and_is_xml():
    x = np.arange(4.0)
    for svg in (polar(), positioning_plot(PositioningCurves("X", "x in mm", x, x, -x, x / 4, x / 4), key="k")):
        alone = standalone(svg)
        assert ET.fromstring(alone).tag == "{http://www.w3.org/2000/svg}svg"
        assert "var(" not in alone
        assert "#0062a3" in alone


def test_missing_numbers_are_null_empty_and_named():
    doc = json.loads(document_json(document()))
    assert [(f["value"], f["expanded"]) for f in doc["figures"]] == [(12.3456, 0.5), (None, None), (None, None)]
    assert doc["decision_rule"] == DECISION_RULE
    rows = list(csv.DictReader(io.StringIO(document_csv(document()))))
    assert (rows[0]["value"], rows[0]["expanded"], rows[0]["limit"]) == ("12.3456", "0.5", "20.0")
    assert (rows[1]["value"], rows[1]["expanded"]) == ("", "")
    assert rows[2]["symbol"] == "'=cmd()"
    assert "12.350.5" in pdf_text(document_pdf(document())).replace("0.50", "0.5")  # rounded with its U, two digits


def test_equal_documents_give_equal_bytes_and_other_ones_do_not():
    assert document_pdf(document()) == document_pdf(document())
    assert document_pdf(document()) != document_pdf(document(conditions={"Air": "21 °C"}))


@pytest.mark.parametrize(("value", "word", "sign"), [(4.0, "pass", "ok"), (10.5, "cannot tell", "open"), (20.0, "fail", "bad")])
def test_limits_are_judged_with_the_guard_band(value, word, sign):
    rules = Rules({"body_diagonal_um": 10.0})
    rows, found = judged({"body_diagonal_um": (value, 1.0), "helix_rms_um": (1.0, 0.1)}, rules, "g")
    assert [(f.limit, f.verdict) for f in rows] == [(10.0, word), (None, "")]
    assert verdict_of(found, [], ("open", "", ""))[0] == sign
    assert verdict_of(found, ["the air ...: the figures cannot be judged"], ("open", "", ""))[:2] == ("open", "Cannot tell")


@pytest.mark.parametrize(
    ("font", "printed", "missing"),
    [("MPLUS1p_400Regular.ttf", ("基準", "きじゅん"), "공작기계"), ("NanumGothic_400Regular.ttf", ("基準", "공작기계"), "フライス")],
)
def test_a_font_of_one_language_does_not_print_the_letters_of_the_other(monkeypatch, tmp_path, font, printed, missing):
    monkeypatch.setattr(document_page, "FONTS", (str(tmp_path),))
    monkeypatch.delenv("ABBE_FONTS", raising=False)
    (tmp_path / font).touch()
    for title in printed:
        assert "".join(NO_FONT.split()) not in pdf_text(document_pdf(document(title=title)))
    assert "".join(NO_FONT.split()) in pdf_text(document_pdf(document(title=missing)))


def test_east_asian_names_have_a_font_or_the_report_says_that_there_is_none(monkeypatch, tmp_path):
    named = document(title="基準 공작기계")
    monkeypatch.setattr(document_page, "FONTS", (str(tmp_path),))
    monkeypatch.delenv("ABBE_FONTS", raising=False)
    assert "".join(NO_FONT.split()) in pdf_text(document_pdf(named))
    assert "".join(NO_FONT.split()) not in pdf_text(document_pdf(document()))
    (tmp_path / "NotoSansCJK-Regular.otf").touch()
    assert "".join(NO_FONT.split()) not in pdf_text(document_pdf(named)), "a font is there, and typst is given its folder"
