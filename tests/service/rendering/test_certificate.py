"""A report as DCC, AQDEF and QIF: valid for other people's validators, and read back by other people's readers."""

from __future__ import annotations

import io
import os
import re
import shutil
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pypdf
import pytest
from aqdefreader import DfqFile, read_dfq_file
from dcc_json_toolkit import DccSchema
from dcclib.validation.schematron import SchematronValidator
from lxml import etree
from signxml import XMLVerifier
from signxml.exceptions import InvalidDigest
from xmlschema import XMLResource, XMLSchema10
from xmlschema.exceptions import XMLResourceParseError

from abbe.service.domain.machine import Issuer, Item
from abbe.service.errors import FileFormatError
from abbe.service.rendering import qif
from abbe.service.rendering.aqdef import document_dfq
from abbe.service.rendering.certificate import UNITS, document_dcc
from abbe.service.rendering.document import Document, Instrument, ReportFigure
from abbe.service.rendering.document_page import document_html, document_pdf
from abbe.service.rendering.qif import document_qif
from tests.conftest import Require

NOT_CLOSED = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")
"""aqdefreader leaves its file to the garbage collector."""
GROUP = "Axis X, set-up L1: positioning, ISO 230-2"
FIGURES = [
    ReportFigure(GROUP, "E", "systematic deviation, both directions", 14.0, 0.47, "µm", "ISO 230-2", 20.0, "pass"),
    ReportFigure(GROUP, "B", "reversal, largest", 3.0, 0.1, "µm", "ISO 230-2", 3.1, "cannot tell"),
    ReportFigure(GROUP, "B mean", "reversal, mean", -1e-7, 0.0, "µm", "ISO 230-2", 1.0, "fail"),
    ReportFigure(GROUP, "R", "repeatability", None, None, "µm", "ISO 230-2"),
    ReportFigure("Ball-bar <XY> & \x07", "AF_SQUARENESS", "squareness", -18.2, None, "µm/m", "as its file states it"),
]
DOCUMENT = Document(
    kind="campaign",
    title="Campaign spring-check",
    about={"Machine": "Fräse <7>", "Chain": "w-X-Y-b-Z-t"},
    verdict=("ok", "Within limits", "By the limits of the machine file."),
    figures=FIGURES,
    instruments=[Instrument("laser displacement meter", "valid to 2027-05-31", "resolution 0.1 µm")],
    conditions={"Air temperature": "20.5 to 20.7 °C"},
    remarks=["no overrun is recorded", "3 cycles"],
    not_observable=["straightness"],
    provenance={"Data (SHA-256)": "ab" * 32, "Report by abbe": "0.1.0"},
    days=("2026-11-22", "2026-11-23"),
    issuer=Issuer(laboratory="Plant 2, metrology", city="Bonn", country="DE", person="A. Bär"),
)


class Validators:
    """XSD and Schematron of the DCC as PTB and others publish them, and a reader that turns a certificate into a dictionary."""

    def __init__(self, dcc: Path, folder: Path) -> None:
        places = {"v3.3.0_dcc": "v3.3.0/dcc", "dsi_v2.2.1": "dsi/v2.2.1", "qudt_v2.2.1": "qudt/v2.2.1"}
        for name, place in (places | {"xmldsig-core-schema": "xmldsig-core-schema"}).items():
            (folder / place).parent.mkdir(exist_ok=True)
            shutil.copyfile(dcc / f"dcc_{name}.xsd", folder / f"{place}.xsd")
        self.folder, self.path = dcc, str(folder / "v3.3.0" / "dcc.xsd")
        self.xsd = XMLSchema10(self.path)
        self.schematron = SchematronValidator.from_file(str(dcc / "dcc.sch"))

    def complaints(self, text: str) -> list[str]:
        """What both find, beside mere information."""
        found = self.schematron.validate_str(text)
        rules = [one for one in (*found.failed_assertions, *found.successful_reports) if one.role != "information"]
        return [f"xsd: {one.reason}" for one in self.xsd.iter_errors(text)] + [f"{one.role}: {one.text}" for one in rules]

    def read(self, text: str) -> dict[str, Any]:
        found: dict[str, Any] = DccSchema("3.3.0", no_cache=True, schema_url=self.path).to_dict(text)
        return found

    def fixture(self, name: str) -> str:
        return (self.folder / f"dcclib_{name}.xml").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def validators(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Validators:
    return Validators(shared / "data" / "foreign" / "dcc", tmp_path_factory.mktemp("xsd"))


RULES = {"schema": {"xsd"}, "schematron": {"error"}, "signature": set[str]()}


def signature_holds(text: str) -> bool:
    """Whether the digests of a signed certificate are right, whoever signed it."""
    root = etree.fromstring(text.encode())
    (holder,) = root.xpath("//*[local-name()='X509Certificate']/text()")
    pem = f"-----BEGIN CERTIFICATE-----\n{holder.strip()}\n-----END CERTIFICATE-----\n"
    try:
        XMLVerifier().verify(root, x509_cert=pem)
    except InvalidDigest:
        return False
    return True


def test_the_validators_tell_four_invalid_certificates_apart(validators: Validators) -> None:
    assert all(one.startswith("warning:") for one in validators.complaints(validators.fixture("valid")))
    with pytest.raises(XMLResourceParseError):
        XMLResource(validators.fixture("invalid_syntax"))
    wrong = {name: {one.partition(":")[0] for one in validators.complaints(validators.fixture(f"invalid_{name}"))} for name in RULES}
    assert {name: found - {"warning"} for name, found in wrong.items()} == RULES
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the certificate of the fixture has a serial number of 0
        assert signature_holds(validators.fixture("valid_signature"))
        assert not signature_holds(validators.fixture("invalid_signature"))


def test_a_report_is_a_certificate_for_both_validators(validators: Validators) -> None:
    assert validators.complaints(document_dcc(DOCUMENT)) == []
    bare = replace(
        DOCUMENT, figures=FIGURES[:1], instruments=[], conditions={}, remarks=[], not_observable=None, verdict=None, provenance={}
    )
    assert validators.complaints(document_dcc(replace(bare, lang="de"))) == []


def text_of(part: Any) -> str:
    (content,) = part["dcc:content"]
    return str(content["$"] if isinstance(content, dict) else content)


def quantities(read: dict[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    (result,) = read["dcc:measurementResults"]["dcc:measurementResult"]
    for group in result["dcc:results"]["dcc:result"]:
        for one in group["dcc:data"]["dcc:quantity"]:
            yield text_of(group["dcc:name"]), text_of(one["dcc:name"]), one


def test_another_reader_finds_every_figure_with_u_unit_limit_and_verdict(validators: Validators) -> None:
    read = validators.read(document_dcc(DOCUMENT))
    core = read["dcc:administrativeData"]["dcc:coreData"]
    assert (core["dcc:uniqueIdentifier"], core["dcc:beginPerformanceDate"], core["dcc:endPerformanceDate"]) == (
        "ab" * 32,
        "2026-11-22",
        "2026-11-23",
    )
    verdicts = {"pass": "pass", "fail": "fail", "cannot tell": "conditionalPass"}
    for figure, (group, name, found) in zip(FIGURES, quantities(read), strict=True):
        assert group == figure.group.replace("\x07", "\ufffd")
        assert name == f"{figure.symbol}: {figure.name}"
        if figure.value is None:
            assert text_of(found["dcc:noQuantity"]) == "not observable"
            continue
        real = found["si:real"]
        assert (float(real["si:value"]), real["si:unit"]) == (figure.value, UNITS[figure.unit])
        expanded = real.get("si:measurementUncertaintyUnivariate", {}).get("si:expandedMU")
        assert (None if expanded is None else float(expanded["si:valueExpandedMU"])) == (None if figure.u is None else 2.0 * figure.u)
        if figure.verdict:
            (judged,) = found["dcc:measurementMetaData"]["dcc:metaData"]
            assert judged["dcc:conformity"] == verdicts[figure.verdict]
            (limit,) = judged["dcc:data"]["dcc:quantity"]
            assert float(limit["si:real"]["si:value"]) == figure.limit


@pytest.mark.parametrize("unit", UNITS)
def test_every_unit_has_a_name_that_the_validators_accept(validators: Validators, unit: str) -> None:
    one = replace(DOCUMENT, figures=[ReportFigure("g", "s", "n", 1.0, 0.1, unit)])
    text = document_dcc(one)
    assert f"<si:unit>{UNITS[unit]}</si:unit>" in text
    assert list(validators.xsd.iter_errors(text)) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"issuer": None}, r"needs the name of its laboratory - write \[issuer\] into the machine file"),
        ({"days": None}, "not on record - give --measured-on DATE"),
        ({"figures": []}, "needs figures"),
        ({"figures": [ReportFigure("g", "s", "n", 1.0, None, "furlong")]}, "the unit 'furlong' of s has no name in D-SI"),
    ],
)
def test_a_certificate_without_its_facts_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(FileFormatError, match=message):
        document_dcc(replace(DOCUMENT, **change))


@NOT_CLOSED
def test_aqdef_comes_back_from_another_reader(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "r.dfq").write_bytes(document_dfq(DOCUMENT))
    read: DfqFile = read_dfq_file(str(tmp_path / "r.dfq"))
    assert "Count of characteristics in DFQ file: 5" in capsys.readouterr().out
    (part,) = read.get_parts()
    assert (part.get_data("K1001"), part.get_data("K1082")) == ("Campaign spring-check", "Fräse <7>")
    for figure, found in zip(FIGURES, part.get_characteristics(), strict=True):
        assert found.get_data("K2001") == figure.symbol
        assert found.get_data("K2142") == figure.unit
        assert found.get_data("K2111") == (None if figure.limit is None else str(figure.limit))
        told = "U is not known" if figure.u is None else f"U = {2 * figure.u!r} µm (k = 2)"
        assert found.get_data("K2900").startswith(told)
        (value,) = found.get_measurements()
        assert float(value.value) == (figure.value or 0.0)
        assert value.attribute == (255 if figure.value is None else 0)
        assert f"{value.datetime:%Y-%m-%d}" == "2026-11-23"


@NOT_CLOSED
def test_the_other_reader_reads_other_peoples_files_too(shared: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """So that its word on ours counts."""
    samples = sorted((shared / "data" / "foreign" / "aqdef").glob("basicDfq_singlePart_three*.dfq"))
    (part,) = read_dfq_file(str(samples[0])).get_parts()
    assert [one.get_data("K2001") for one in part.get_characteristics()] == [f"<characteristic_code_{k}>" for k in (1, 2, 3)]
    capsys.readouterr()


QIF = f"{{{qif.NAMESPACE}}}"


@pytest.mark.filterwarnings("ignore::xmlschema.XMLSchemaImportWarning")
def test_qif_is_valid_by_the_schema_of_the_standard(require: Require) -> None:
    """No package holds the schema: ABBE_QIF_SCHEMA names the folder with QIFDocument.xsd, e.g. of the QIF community."""
    folder = Path(os.environ.get("ABBE_QIF_SCHEMA", "/nonexistent"))
    require("qif", (folder / "QIFDocument.xsd").is_file(), "ABBE_QIF_SCHEMA names no folder with QIFDocument.xsd")
    schema = XMLSchema10(folder / "QIFDocument.xsd", allow="local")  # it names a schema of signatures on another computer
    for figures in (FIGURES, FIGURES[:1], FIGURES[3:]):
        assert [error.reason for error in schema.iter_errors(document_qif(replace(DOCUMENT, figures=figures)))] == []
    spoilt = document_qif(DOCUMENT).replace(">INDETERMINATE<", ">PERHAPS<")
    assert len(list(schema.iter_errors(spoilt))) == 1


def test_every_figure_is_in_qif_with_u_unit_limit_and_status() -> None:
    root = etree.fromstring(document_qif(DOCUMENT).encode())
    items = {one.get("id"): one for one in root.iter(f"{QIF}UserDefinedUnitCharacteristicItem")}
    nominals = {one.get("id"): one for one in root.iter(f"{QIF}UserDefinedUnitCharacteristicNominal")}
    found = list(root.iter(f"{QIF}UserDefinedUnitCharacteristicMeasurement"))
    judged = [figure for figure in FIGURES if figure.limit is not None]
    for figure, measured in zip(judged, found, strict=True):
        item = items[measured.findtext(f"{QIF}CharacteristicItemId")]
        limit = nominals[item.findtext(f"{QIF}CharacteristicNominalId")].find(f"{QIF}MaxValue")
        value = measured.find(f"{QIF}Value")
        assert (item.findtext(f"{QIF}Name"), value.get("unitName"), limit.get("unitName")) == (figure.symbol, "µm", "µm")
        assert [float(one) for one in (value.text, value.get("combinedUncertainty"), limit.text)] == [figure.value, figure.u, figure.limit]
    status = [one.findtext(f"{QIF}Status/{QIF}CharacteristicStatusEnum") for one in found]
    assert status == ["PASS", "INDETERMINATE", "FAIL"]
    others = {one.get("name"): one.get("value") for one in root.iter(f"{QIF}AttributeStr")}
    assert others[f"{GROUP}: R"] == "not observable"
    assert others["Ball-bar <XY> & \ufffd: AF_SQUARENESS"] == "-18.2 µm/m; U is not known"
    assert (others["Machine"], others["Measured"]) == ("Fräse <7>", "2026-11-22 to 2026-11-23")
    numbers = [int(one.get("id")) for one in root.iter() if one.get("id")]
    assert (len(set(numbers)), int(root.get("idMax"))) == (len(numbers), max(numbers))
    beyond = ReportFigure("g", "t", "n", 1.0, 0.1, "", limit=float("nan"))
    odd = [ReportFigure("g\x07", "s", "n", 1.0, 1e-13, "\x07", limit=1.0), beyond]
    root = etree.fromstring(document_qif(replace(DOCUMENT, figures=odd, conditions={"a\x07": "b\ud800"})).encode())
    (value,) = root.iter(f"{QIF}Value")
    assert (value.get("unitName"), value.get("combinedUncertainty")) == ("\ufffd", None)
    assert document_qif(replace(DOCUMENT, issued="2026-11-27")) == document_qif(replace(DOCUMENT, issued="2026-11-28"))
    with pytest.raises(FileFormatError, match="QIF holds figures"):
        document_qif(replace(DOCUMENT, figures=[]))


LABORATORY = Issuer(
    laboratory="Plant 2, metrology", address="Ringstr. 1", city="Bonn", country="DE", person="A. Bär", procedure="VA-17, edition 3",
    prefix="CAL-", customer="Fräserei Muster", customer_address="Talweg 2, Köln",
)  # fmt: skip
ITEM = Item(maker="Muster", model="M 5", serial="4711", place="hall 3")
BAR = Instrument("ball-bar", "Maker, serial 1; certificate 12 of laboratory L; valid to 2027-05-31", "length calibrated")
WHOLE = replace(DOCUMENT, issuer=LABORATORY, item=ITEM, issued="2026-11-24", instruments=[BAR])


def pages_of(document: Document) -> list[str]:
    return [" ".join(page.extract_text().split()) for page in pypdf.PdfReader(io.BytesIO(document_pdf(document))).pages]


def test_a_laboratory_makes_a_report_a_certificate_with_what_iso_17025_wants() -> None:
    pages = pages_of(WHOLE)
    number = re.search(r"CAL-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}", pages[0])
    assert number is not None
    assert all(number[0] in page and f"page {n} of {len(pages)}" in page for n, page in enumerate(pages, 1))
    text = " ".join(pages)
    parties = ("Ringstr. 1, Bonn, DE", "none is claimed", "Fräserei Muster, Talweg 2, Köln", "A. Bär")
    item = ("Muster, M 5, serial 4711", "at the customer's, hall 3", "2026-11-22 to 2026-11-23", "Issued on 2026-11-24")
    how = ("VA-17, edition 3; ISO 230-2", "certificate 12 of laboratory L", "ISO 14253-1", "traceable to the SI through")
    limits = ("Calibration certificate", "relate only to the item", "reproduced in full only", "No calibration interval")
    for words in (*parties, *item, *how, *limits):
        assert words in text, words
    assert "Missing for" not in text
    assert number[0] in document_html(WHOLE)
    other = replace(WHOLE, figures=FIGURES[1:])
    assert number[0] not in pages_of(other)[0], "other results have another number"
    later = replace(WHOLE, issued="2026-11-25")
    assert number[0] in pages_of(later)[0], "a copy of another day has the same"


def test_what_is_missing_for_a_certificate_is_said_and_nothing_is_claimed_for_it() -> None:
    text = " ".join(pages_of(replace(DOCUMENT, days=None)))
    for clause in ("7.8.2.1 b", "7.8.2.1 g", "7.8.2.1 i", "7.8.4.1 c"):
        assert clause in text, clause
    assert "traceability is not stated" in text
    assert "traceable to the SI" not in text
    for kind, issuer in (("push", LABORATORY), ("campaign", None)):
        assert "certificate states" not in " ".join(pages_of(replace(WHOLE, kind=kind, issuer=issuer)))
