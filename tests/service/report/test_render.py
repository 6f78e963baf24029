"""The page: complete, well formed, the same every time, and unmoved by hostile or missing values."""

from __future__ import annotations

import dataclasses
import re
import xml.etree.ElementTree as ET
from html.parser import HTMLParser

import numpy as np

from abbe.service.rendering.document import Document, Facts, Instrument, Lines, PictureBlock, ReportFigure, Section, TextTable
from abbe.service.rendering.document_page import document_html
from abbe.service.rendering.model import ArrowField, Contribution, ParameterRow, PolarTrace, ResidualSeries, TableCurve
from abbe.service.rendering.plots import contribution_bars, diagonal_plot, polar_plot, table_plot, volume_pair
from abbe.service.report.blocks import (
    RunRow,
    SummaryRow,
    parameter_pictures,
    parameter_table,
    residual_picture,
    run_table,
    summary_table,
)

VOID = {"meta", "br", "hr", "img", "link", "input"}
HOSTILE = "</title><script>alert(1)</script><img src=x onerror=alert(2)>\"'&\x00\x07\ud800"


class Outline(HTMLParser):
    """Checks that every tag is closed in order, and collects what the tests ask for."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str | None]] = []
        self.words: list[str] = []
        self.feed(page)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += attrs
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += attrs

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def svgs(page: str) -> list[ET.Element]:
    return [ET.fromstring(text) for text in re.findall(r"<svg.*?</svg>", page, flags=re.DOTALL)]


def test_a_full_report_has_every_section_and_the_verdict_first(full_report: Document) -> None:
    page = document_html(full_report)
    outline = Outline(page)
    assert "script" not in outline.tags
    order = ("verdict", "remarks", "section-1", "section-2", "appendix-1", "appendix-2", "appendix-3")
    places = [page.index(f'id="{name}"') for name in order]
    assert places == sorted(places)
    assert page.index("volume-before-t") < page.index('id="section-2"') < page.index("What this measurement could not show")
    assert page.index('id="appendix-3"') < page.index("Where it comes from")
    assert outline.tags.count("h1") == 1
    assert ("lang", "en") in outline.attributes


def test_every_picture_is_xml_with_its_own_title_and_description(full_report: Document) -> None:
    pictures = svgs(document_html(full_report))
    assert len(pictures) == 2 + 1 + 1 + 1 + 3 + 1 + 1 + 4
    for picture in pictures:
        title, desc = picture.find("title"), picture.find("desc")
        assert title is not None
        assert desc is not None
        assert title.text
        assert desc.text
        assert picture.get("role") == "img"


def test_identifiers_are_unique(full_report: Document) -> None:
    ids = [value for name, value in Outline(document_html(full_report)).attributes if name == "id"]
    assert len(ids) == len(set(ids))


def test_the_page_asks_no_other_host_for_anything(full_report: Document) -> None:
    page = document_html(full_report)
    assert not re.search(r"https?:|//[a-z]|@import|url\(|\bsrc=|\bhref=", page)


def test_equal_reports_give_equal_bytes(full_report: Document) -> None:
    again = dataclasses.replace(full_report, sections=list(full_report.sections))
    assert document_html(full_report) == document_html(again)


def test_a_report_without_data_still_renders(minimal_report: Document) -> None:
    page = document_html(minimal_report)
    Outline(page)
    assert svgs(page) == []
    assert "No measurement was made." in page
    assert "Undecided" in page


def test_the_uncertainty_decides_the_digits(full_report: Document) -> None:
    page = document_html(full_report)
    assert re.search(r"41\.3<span class=\"u\"> ± 1\.0<", page)
    assert re.search(r"18\.20<span class=\"u\"> ± 0\.62<", page)


def test_what_the_correction_reached_is_bold(full_report: Document) -> None:
    row = re.search(r"<tr><th scope=\"row\">Volumetric error, rms</th>.*?</tr>", document_html(full_report))
    assert row is not None
    assert re.findall(r"<td class=\"r strong\">([\d.]+)", row[0]) == ["2.91", "6.3"]
    assert row[0].count("strong") == 2


def test_parameters_of_the_set_up_are_folded_away(full_report: Document) -> None:
    page = document_html(full_report)
    fold = page[page.index("<details>") : page.index("</details>")]
    assert ">cup B1 x<" in fold
    assert ">EXX slope<" not in fold
    assert page.count('<th scope="row">cup B1 x<') == 1


def test_hostile_words_stay_words(minimal_report: Document) -> None:
    x = [0.0, 1.0]
    pictures = [
        *parameter_pictures([ParameterRow(HOSTILE, 1.0, 0.1, HOSTILE)], [Contribution(HOSTILE, 1.0, 0.1)]),
        *residual_picture([ResidualSeries(HOSTILE, HOSTILE, x, x)], [RunRow(HOSTILE, HOSTILE, HOSTILE, 1, 1.0, 1.0)]),
        PictureBlock(HOSTILE, [table_plot([TableCurve(HOSTILE, HOSTILE, x, x)]), diagonal_plot({HOSTILE: (x, x)}, {})], "wide"),
        PictureBlock(HOSTILE, [polar_plot([PolarTrace(HOSTILE, x, x)])]),
    ]
    words = [HOSTILE, Lines([HOSTILE]), Facts({HOSTILE: HOSTILE}), TextTable((HOSTILE, HOSTILE), [(HOSTILE, HOSTILE)])]
    report = dataclasses.replace(
        minimal_report,
        title=HOSTILE,
        lang=HOSTILE,
        about={HOSTILE: HOSTILE},
        verdict=("open", HOSTILE, HOSTILE),
        remarks=[HOSTILE],
        sections=[Section(HOSTILE, [*words, Section(HOSTILE, words, folded=True)]), Section("P", pictures)],
        figures=[ReportFigure(HOSTILE, HOSTILE, HOSTILE, 1.0, 0.1, HOSTILE, HOSTILE)],
        statements=[HOSTILE],
        not_observable=[HOSTILE],
        instruments=[Instrument(HOSTILE, HOSTILE, HOSTILE)],
        conditions={HOSTILE: HOSTILE},
        appendix=[Section(HOSTILE, words)],
        provenance={HOSTILE: HOSTILE},
        signatures=[HOSTILE],
    )
    page = document_html(report)
    outline = Outline(page)
    assert not {"script", "img"} & set(outline.tags)
    assert not [name for name, _ in outline.attributes if name.startswith("on")]
    assert len(svgs(page)) == 6
    page.encode()


def test_missing_numbers_are_named_not_drawn(minimal_report: Document) -> None:
    nan, inf = float("nan"), float("inf")
    grid = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, nan], [2.0, 2.0, 2.0]])
    series = [ResidualSeries("r1", "t in s", [nan, nan], [nan, nan]), ResidualSeries("r2", "t in s", [], []), _gappy()]
    rows = [ParameterRow("p", nan, 1.0, "µm"), ParameterRow("q", 1.0, inf, "µm"), ParameterRow("r", None, None, "µm")]
    runs = [RunRow("r1", "t", "identify", 0, nan, nan)]
    summary = [SummaryRow("a", "µm", nan, 0.0, nan, inf), SummaryRow("b", "µm", None, None)]
    pictures = [
        *volume_pair(ArrowField(grid, np.full((3, 3), nan)), ArrowField(np.empty((0, 3)), np.empty((0, 3)))),
        table_plot([TableCurve("X", "X", [0.0, 1.0, 2.0], [nan, 1.0, inf])], lsb_um=nan),
        diagonal_plot({}, {"ppp": ([0.0, nan, 2.0], [1.0, 2.0, nan])}),
        polar_plot([PolarTrace("p", [0.0, nan], [nan, 1.0])]),
        contribution_bars([Contribution("c", nan, nan), Contribution("d", None), Contribution("e", 2.0, nan)]),
    ]
    blocks = [
        summary_table(summary),
        parameter_table(rows),
        *parameter_pictures(rows, []),
        *residual_picture(series, runs),
        run_table(runs),
    ]
    figures = [
        ReportFigure("g", "a", "missing", nan, 1.0, "µm"),
        ReportFigure("g", "b", "not known", 1.0, inf, "µm"),
        ReportFigure("g", "c", "none", None, None, ""),
    ]
    report = dataclasses.replace(minimal_report, sections=[Section("s", [*blocks, PictureBlock("c", pictures)])], figures=figures)
    page = document_html(report)
    Outline(page)
    assert "n/a" in page
    assert not re.search(r"\b(nan|inf)\b", page)
    for picture in svgs(page):
        for element in picture.iter():
            assert not {"nan", "inf", "-inf"} & set(re.split(r"[ ,]", " ".join(element.attrib.values())))


def _gappy() -> ResidualSeries:
    y = np.linspace(-1.0, 1.0, 4000)
    y[::7] = np.nan
    return ResidualSeries("r3", "t in s", np.arange(4000.0), y)
