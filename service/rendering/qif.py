"""The figures of a report as QIF 3.0 results (ISO 23952, .qif): each figure with a limit is a characteristic with its status.

A characteristic of QIF has a limit. A figure without a limit is therefore written as text among the attributes of the results, beside
machine, days, laboratory and conditions.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import replace
from itertools import count
from uuid import UUID, uuid5

from abbe.service.errors import FileFormatError
from abbe.service.rendering.document import Document, ReportFigure
from abbe.service.rendering.numbers import COVERAGE, finite, printable

NAMESPACE = "http://qifstandards.org/xsd/qif3"
VERSION = "3.0.0"
STATUS = {"pass": "PASS", "fail": "FAIL", "cannot tell": "INDETERMINATE"}
_REPORTS = UUID("5d1bb0c2-7b0e-4a3c-9d3e-6f5b8a1c2e40")
"""Name space of the reports' identifiers (RFC 9562, version 5)."""
_KIND = "UserDefinedUnitCharacteristic"


def document_qif(document: Document) -> str:
    """The report as XML. Equal reports give equal bytes. ``combinedUncertainty`` is the standard uncertainty of a value.

    Raises
    ------
    FileFormatError
        The report has no figure.
    """
    if not document.figures:
        raise FileFormatError("QIF holds figures; this report has none", "give a campaign with results")
    judged = [figure for figure in document.figures if finite(figure.limit)]
    numbers = count(1)
    standard, results = next(numbers), next(numbers)
    ids = [tuple(next(numbers) for _ in range(4)) for _ in judged]  # of definition, nominal, item and measurement
    root = ET.Element("QIFDocument", {"xmlns": NAMESPACE, "xmlns:xsi": "http://www.w3.org/2001/XMLSchema-instance"})
    root.append(_tag("QPId", str(uuid5(_REPORTS, repr(replace(document, issued=""))))))
    root.append(_tag("Header", _tag("Application", _tag("Name", "Abbe")), _tag("Description", document.title)))
    organisation = _tag("Organization", _tag("StandardsOrganizationEnum", "ISO"))
    root.append(_list("StandardsDefinitions", [_tag("Standard", organisation, _tag("Designator", "230"), id=standard)]))
    root.append(_units(judged))
    if judged:
        root.append(_characteristics(judged, ids, standard))
    root.append(_tag("Results", _list("MeasurementResultsSet", [_results(document, judged, ids, results)])))
    root.set("idMax", str(next(numbers) - 1))
    root.set("versionQIF", VERSION)
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _tag(tag: str, /, *inside: ET.Element | str, **attributes: object) -> ET.Element:
    out = ET.Element(tag, {key: _clean(value) for key, value in attributes.items()})
    for one in inside:
        if isinstance(one, str):
            out.text = _clean(one)
        else:
            out.append(one)
    return out


def _clean(text: object) -> str:
    """Text that XML and UTF-8 can hold, in one line."""
    return " ".join(printable(text).encode(errors="replace").decode().split())


def _list(name: str, items: Sequence[ET.Element]) -> ET.Element:
    return _tag(name, *items, n=len(items))


def _unit(figure: ReportFigure) -> str:
    return figure.unit or "1"


def _units(figures: Sequence[ReportFigure]) -> ET.Element:
    metre = _tag("LinearUnit", _tag("SIUnitName", "meter"), _tag("UnitName", "mm"), _tag("UnitConversion", _tag("Factor", "0.001")))
    own = [
        _tag("UserDefinedUnit", _tag("WhatIsMeasured", "error of a machine"), _tag("UnitName", unit))
        for unit in dict.fromkeys(_unit(figure) for figure in figures)
    ]
    return _tag("FileUnits", _tag("PrimaryUnits", metre), *([_list("UserDefinedUnits", own)] if own else []))


def _characteristics(figures: Sequence[ReportFigure], ids: Sequence[tuple[int, ...]], standard: int) -> ET.Element:
    definitions, nominals, items = [], [], []
    for figure, (definition, nominal, item, _) in zip(figures, ids, strict=True):
        definitions.append(_tag(f"{_KIND}Definition", id=definition))
        nominals.append(
            _tag(
                f"{_KIND}Nominal",
                _tag("CharacteristicDefinitionId", str(definition)),
                _tag("TargetValue", "0", unitName=_unit(figure)),
                _tag("MaxValue", _decimal(figure.limit), unitName=_unit(figure)),
                _tag("DefinedAsLimit", "true"),
                id=nominal,
            )
        )
        words = _tag("Description", "; ".join(part for part in (figure.group, figure.name, figure.method) if part))
        items.append(_tag(f"{_KIND}Item", words, _tag("Name", figure.symbol), _tag("CharacteristicNominalId", str(nominal)), id=item))
    return _tag(
        "Characteristics",
        _tag("FormalStandardId", str(standard)),
        _list("CharacteristicDefinitions", definitions),
        _list("CharacteristicNominals", nominals),
        _list("CharacteristicItems", items),
    )


def _results(document: Document, judged: Sequence[ReportFigure], ids: Sequence[tuple[int, ...]], number: int) -> ET.Element:
    others = [figure for figure in document.figures if not finite(figure.limit)]
    days = {"Measured": " to ".join(dict.fromkeys(document.days))} if document.days is not None else {}
    laboratory = {} if document.issuer is None else {"Laboratory": document.issuer.laboratory}
    known = {**document.about, **days, **laboratory, **document.conditions}
    texts = [(f"{figure.group}: {figure.symbol}", _told(figure)) for figure in others] + list(known.items())
    parts = [_list("Attributes", [_tag("AttributeStr", name=name, value=text) for name, text in texts])]
    if judged:
        measured = [_measurement(figure, own) for figure, own in zip(judged, ids, strict=True)]
        parts.append(_tag("MeasuredCharacteristics", _list("CharacteristicMeasurements", measured)))
    status = {"ok": "PASS", "bad": "FAIL"}.get(document.verdict[0] if document.verdict else "", "UNKNOWN")
    return _tag(
        "MeasurementResults", *parts[0 if texts else 1 :], _tag("InspectionStatus", _tag("InspectionStatusEnum", status)), id=number
    )


def _measurement(figure: ReportFigure, ids: tuple[int, ...]) -> ET.Element:
    status = _tag("Status", _tag("CharacteristicStatusEnum", STATUS.get(figure.verdict, "NOT_ANALYZED")))
    parts = [status, _tag("CharacteristicItemId", str(ids[2]))]
    if finite(figure.value):
        known = {"combinedUncertainty": _decimal(figure.u)} if finite(figure.u) and (figure.u == 0.0 or _decimal(figure.u) != "0") else {}
        parts.append(_tag("Value", _decimal(figure.value), **known, unitName=_unit(figure)))
    return _tag(f"{_KIND}Measurement", *parts, id=ids[3])


def _decimal(value: float | None) -> str:
    """A number as xs:decimal, which has no exponent."""
    return f"{value:.12f}".rstrip("0").rstrip(".")


def _told(figure: ReportFigure) -> str:
    if not finite(figure.value):
        return "not observable"
    known = f"U = {_decimal(COVERAGE * figure.u)} {figure.unit} (k = {COVERAGE:g})" if finite(figure.u) else "U is not known"
    return f"{_decimal(figure.value)} {figure.unit}; {known}"
