"""The figures of a report in the Q-DAS ASCII transfer format (AQDEF, .dfq), one characteristic for each figure."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import date

from abbe.service.errors import FileFormatError
from abbe.service.rendering.document import Document, ReportFigure
from abbe.service.rendering.numbers import COVERAGE, finite, tidy

VALID, INVALID = 0, 255
"""Attribute K0002 of a valid and of an invalid value."""


def document_dfq(document: Document) -> bytes:
    """The report as AQDEF: UTF-8 with byte order mark, CRLF. Equal reports give equal bytes.

    A figure that is not observable is a value with attribute 255. U has no separate field, so it is in the remark of its characteristic.

    Raises
    ------
    FileFormatError
        The report has no figure.
    """
    if not document.figures:
        raise FileFormatError("AQDEF holds figures; this report has none", "give a campaign with results")
    machine = document.about.get("Machine") or document.title
    lines = [f"K0100 {len(document.figures)}", f"K1001/1 {_one_line(document.title)}", f"K1002/1 {_one_line(machine)}"]
    lines.append(f"K1082/1 {_one_line(machine)}")
    for number, figure in enumerate(document.figures, start=1):
        lines += _characteristic(figure, number)
    for number, figure in enumerate(document.figures, start=1):
        lines += _value(figure, number, document.days)
    return "\r\n".join([*lines, ""]).encode("utf-8-sig")


def _characteristic(figure: ReportFigure, number: int) -> Iterator[str]:
    yield f"K2001/{number} {_one_line(figure.symbol)}"
    yield f"K2002/{number} {_one_line(f'{figure.group}: {figure.name}')}"
    if figure.limit is not None:
        yield f"K2111/{number} {figure.limit!r}"
    if figure.unit:
        yield f"K2142/{number} {figure.unit}"
    uncertainty = f"U = {COVERAGE * figure.u!r} {figure.unit} (k = {tidy(COVERAGE)})" if finite(figure.u) else "U is not known"
    method = f"; {figure.method}" if figure.method else ""
    yield f"K2900/{number} {_one_line(uncertainty + method)}"


def _value(figure: ReportFigure, number: int, days: tuple[str, str] | None) -> Iterator[str]:
    yield f"K0001/{number} {float(figure.value) if finite(figure.value) else 0.0!r}"
    yield f"K0002/{number} {VALID if finite(figure.value) else INVALID}"
    if days is not None:
        yield f"K0004/{number} {date.fromisoformat(days[1]):%d.%m.%Y}/00:00:00"


def _one_line(text: str) -> str:
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())
