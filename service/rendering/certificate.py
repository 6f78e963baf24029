"""A report as a digital calibration certificate: DCC 3.3.0 of PTB with D-SI 2.2.1 units. Unsigned; a laboratory signs it with its own seal.

Figures with U (k = 2), limits and conformity stand in ``measurementResults``; conditions and remarks are text. Rules: XSD and Schematron of
the DCC.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from importlib.metadata import version
from itertools import groupby

from abbe.service.domain.machine import Issuer
from abbe.service.errors import FileFormatError
from abbe.service.rendering.document import DECISION_RULE, UNCERTAINTY, Document, ReportFigure
from abbe.service.rendering.numbers import COVERAGE, finite, printable, tidy
from abbe.service.rendering.phrases import ENGLISH

SCHEMA = "3.3.0"
NAMESPACES = {"xmlns:dcc": "https://ptb.de/dcc", "xmlns:si": "https://ptb.de/si", "schemaVersion": SCHEMA}
UNITS = {
    "": r"\one",
    "%": r"\percent",
    "nm": r"\nano\metre",
    "µm": r"\micro\metre",
    "mm": r"\milli\metre",
    "m": r"\metre",
    "µm/m": r"\micro\metre\per\metre",
    "µm/m/K": r"\micro\metre\per\metre\per\kelvin",
    "µrad": r"\micro\radian",
    "mrad": r"\milli\radian",
    "rad": r"\radian",
    "s": r"\second",
    "ms": r"\milli\second",
    "min": r"\minute",
    "h": r"\hour",
    "K": r"\kelvin",
    "°C": r"\degreecelsius",
    "K/h": r"\kelvin\per\hour",
    "mm/min": r"\milli\metre\per\minute",
    "Pa": r"\pascal",
    "Hz": r"\hertz",
}
"""D-SI name of each unit of a report."""
PROBABILITY = "0.95"
DATA = "Data (SHA-256)"


def document_dcc(document: Document) -> str:
    """The report as XML. Equal reports give equal bytes.

    Raises
    ------
    FileFormatError
        Issuer or dates of the measurement are unknown, there is no figure, or a unit has no name in D-SI.
    """
    if document.issuer is None:
        raise FileFormatError("a digital certificate needs the name of its laboratory", "write [issuer] into the machine file")
    if document.days is None:
        raise FileFormatError("a digital certificate needs the days of the measurement, which are not on record", "give --measured-on DATE")
    if not document.figures:
        raise FileFormatError("a digital certificate needs figures; this report has none", "give a campaign with results")
    root = ET.Element("dcc:digitalCalibrationCertificate", NAMESPACES)
    root.append(_administrative(document, document.issuer, document.days))
    root.append(_tag("measurementResults", _result(document)))
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _tag(name: str, *inside: ET.Element | str | None, kind: str = "") -> ET.Element:
    """Return an element of the DCC (or ``si:``); parts of ``inside`` that are None are left out; ``kind``: its refType."""
    out = ET.Element(name if ":" in name else f"dcc:{name}", {"refType": kind} if kind else {})
    for one in inside:
        if isinstance(one, str):
            out.text = " ".join(printable(one).split())
        elif one is not None:
            out.append(one)
    return out


def _text(document: Document, name: str, words: str) -> ET.Element:
    """An element that holds one text; files for programs are English."""
    content = _tag("content", words)
    content.set("lang", ENGLISH)
    return _tag(name, content)


def _software(document: Document, name: str) -> ET.Element:
    plain = re.match(r"\d{1,3}(\.\d{1,3}){0,3}", version("abbe"))
    assert plain is not None
    return _tag(name, _tag("software", _text(document, "name", "Abbe"), _tag("release", f"v{plain.group()}")))


def _administrative(document: Document, issuer: Issuer, days: tuple[str, str]) -> ET.Element:
    machine = document.about.get("Machine") or document.title
    core = _tag(
        "coreData",
        _tag("countryCodeISO3166_1", issuer.country),
        _tag("usedLangCodeISO639_1", ENGLISH),
        _tag("mandatoryLangCodeISO639_1", ENGLISH),
        _tag("uniqueIdentifier", document.provenance.get(DATA) or document.title),
        _tag("beginPerformanceDate", days[0]),
        _tag("endPerformanceDate", days[1]),
        _tag("performanceLocation", issuer.place),
    )
    number = _tag("identification", _tag("issuer", "customer"), _tag("value", machine), _text(document, "name", "name of the machine"))
    known = document.item
    named = {"Maker": known.maker, "Model": known.model, "Serial": known.serial} if known is not None else {}
    facts = "; ".join(f"{name}: {value}" for name, value in {**document.about, **named}.items() if value)
    item = _tag("item", _text(document, "name", machine), _text(document, "description", facts), _tag("identifications", number))
    person = _tag("respPerson", _tag("person", _text(document, "name", issuer.person)), _tag("mainSigner", "true"))
    return _tag(
        "administrativeData",
        _software(document, "dccSoftware"),
        core,
        _tag("items", item),
        _tag("calibrationLaboratory", _contact(document, "contact", issuer.laboratory, issuer)),
        _tag("respPersons", person),
        _contact(document, "customer", issuer.customer or issuer.laboratory, issuer),
        _tag("statements", *(_statement(document, text) for text in _statements(document))),
    )


def _contact(document: Document, name: str, who: str, issuer: Issuer) -> ET.Element:
    return _tag(name, _text(document, "name", who), _tag("location", _tag("city", issuer.city), _tag("countryCode", issuer.country)))


def _statements(document: Document) -> list[str]:
    hidden = [f"Not observable: {line}" for line in document.not_observable or ()]
    verdict = [] if document.verdict is None else [f"{document.verdict[1]}. {document.verdict[2]}".strip()]
    return [*verdict, DECISION_RULE, *hidden, *(f"{name}: {value}" for name, value in document.provenance.items())]


def _statement(document: Document, text: str) -> ET.Element:
    return _tag("statement", _text(document, "declaration", text))


def _result(document: Document) -> ET.Element:
    methods = dict.fromkeys(figure.method or "Abbe" for figure in document.figures)
    uncertainty = _tag(
        "usedMethod",
        _text(document, "name", "uncertainty"),
        _text(document, "description", " ".join((UNCERTAINTY, *document.statements))),
        _tag("norm", "JCGM 100"),
        kind="basic_uncertainty",
    )
    tools = [
        _tag("measuringEquipment", _text(document, "name", one.name), _text(document, "description", f"{one.certificate}; {one.known}"))
        for one in document.instruments
    ]
    stated = document.conditions or {"Conditions": "none on record"}
    conditions = [
        _tag("influenceCondition", _text(document, "name", name), _tag("data", _text(document, "text", value)))
        for name, value in stated.items()
    ]
    groups = [_group(document, name, list(figures)) for name, figures in groupby(document.figures, key=lambda one: one.group)]
    return _tag(
        "measurementResult",
        _text(document, "name", document.title),
        _text(document, "description", " ".join(document.remarks)) if document.remarks else None,
        _tag("usedMethods", *(_tag("usedMethod", _text(document, "name", one)) for one in methods), uncertainty),
        _software(document, "usedSoftware"),
        _tag("measuringEquipments", *tools) if tools else None,
        _tag("influenceConditions", *conditions),
        _tag("results", *groups),
    )


def _group(document: Document, name: str, figures: list[ReportFigure]) -> ET.Element:
    return _tag("result", _text(document, "name", name), _tag("data", *(_quantity(document, one) for one in figures)))


def _quantity(document: Document, figure: ReportFigure) -> ET.Element:
    name = _text(document, "name", f"{figure.symbol}: {figure.name}")
    if not finite(figure.value):
        return _tag("quantity", name, _text(document, "noQuantity", "not observable"))
    judged = None if figure.limit is None or not figure.verdict else _tag("measurementMetaData", _conformity(document, figure))
    return _tag("quantity", name, _real(figure.value, figure.u, figure), judged)


def _real(value: float, u: float | None, figure: ReportFigure) -> ET.Element:
    if figure.unit not in UNITS:
        raise FileFormatError(f"the unit {figure.unit!r} of {figure.symbol} has no name in D-SI", "write the report as .json or .csv")
    expanded = None
    if finite(u):
        expanded = _tag(
            "si:measurementUncertaintyUnivariate",
            _tag(
                "si:expandedMU",
                _tag("si:valueExpandedMU", repr(COVERAGE * float(u))),
                _tag("si:coverageFactor", tidy(COVERAGE)),
                _tag("si:coverageProbability", PROBABILITY),
                _tag("si:distribution", "normal"),
            ),
        )
    return _tag("si:real", _tag("si:value", repr(float(value))), _tag("si:unit", UNITS[figure.unit]), expanded)


def _conformity(document: Document, figure: ReportFigure) -> ET.Element:
    """Return the conformity by the decision rule. If the measurement cannot decide, the value alone decides, and the status is
    conditional."""
    assert figure.value is not None
    assert figure.limit is not None
    inside = "conditionalPass" if abs(figure.value) <= figure.limit else "conditionalFail"
    status = figure.verdict if figure.verdict in ("pass", "fail") else inside
    limit = _tag("quantity", _text(document, "name", "limit"), _real(figure.limit, None, figure), kind="basic_acceptanceLimitUpper")
    return _tag(
        "metaData",
        _text(document, "declaration", "conformity by ISO 14253-1"),
        _tag("conformity", status),
        _tag("data", limit),
        kind="basic_conformity",
    )
