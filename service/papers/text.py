"""Rows as text: numbers with their significant digits, columns of a table in one line, notes."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

from abbe.service.papers.check import PaperCheck
from abbe.service.papers.compare import FLOAT, OPERANDS
from abbe.service.papers.printed import Printed
from abbe.service.papers.row import PaperRow

NONE = "–"
_HYPHEN = re.compile(r"(?<![\w.])-(?=\d)|(?<=\de)-(?=\d)")
"""A hyphen that stands for a minus sign."""


@dataclass(frozen=True, slots=True)
class PrintedLine:
    """One line of a table: a row, or a whole column whose rows have one status."""

    where: str
    quantity: str
    printed: str
    computed: str
    difference: str
    within: str
    status: str
    note: str


def digits_like(value: float, number: Printed) -> str:
    """A computed value with one digit more than the printed number, in the same notation."""
    text = (number.last or number.text).lower()
    mantissa, _, exponent = text.partition("e")
    decimals = len(mantissa.partition(".")[2]) + 1
    return minus(f"{value:.{decimals}{'e' if exponent else 'f'}}")


def short(value: float) -> str:
    """Two significant digits."""
    return minus("0" if value == 0.0 else f"{value:.1e}" if not 1e-3 <= abs(value) < 1e5 else f"{value:.2g}")


def note(row: PaperRow) -> str:
    """Basis and reason of the status, and the effect of the erratum."""
    parts = [part for part in (row.remark, row.why) if part]
    if row.erratum is not None:
        again = ""
        if row.erratum.again is not None:
            again = f": with it {digits_like(row.erratum.again.value, row.printed)}, printed {minus(row.printed.text)}, {row.gap}"
        parts.append(f"erratum: {row.erratum.text}{again}")
    if row.computed is not None and row.computed.because not in ("", OPERANDS):
        parts.append(f"± {row.computed.because}")
    return _HYPHEN.sub("−", "; ".join(parts))


def lines(rows: Sequence[PaperRow]) -> Iterator[PrintedLine]:
    """Lines of a table; neighbouring rows of one series and one status become one line with its worst difference."""
    for _, group in groupby(rows, key=lambda r: (r.series, r.status) if r.series else (id(r), r.status)):
        members = list(group)
        yield _line(members[0]) if len(members) == 1 else _column(members)


def _line(row: PaperRow) -> PrintedLine:
    sign = "< " if row.printed.bound else ""
    printed = sign + minus(row.printed.text)
    return PrintedLine(row.where, f"{row.quantity}{_unit(row.unit)}", printed, *computed_cells(row), row.status, note(row))


def computed_cells(row: PaperRow) -> tuple[str, str, str]:
    """Computed value, difference and allowed difference."""
    if row.computed is None or row.difference is None:
        return NONE, NONE, NONE
    within = NONE if row.within is None else short(row.within)
    dust = abs(row.difference) <= FLOAT * max(abs(row.computed.value), abs(row.printed.value))
    return digits_like(row.computed.value, row.printed), short(0.0 if dust else row.difference), within


def _column(rows: list[PaperRow]) -> PrintedLine:
    first = rows[0]
    unit = _unit(_common(r.unit for r in rows))
    name = f"{first.series}{unit}, worst of {len(rows)}"
    compared = [r for r in rows if r.difference is not None and r.computed is not None]
    if not compared:
        return PrintedLine(first.where, f"{first.series}{unit}", f"{len(rows)} values", NONE, NONE, NONE, first.status, note(first))
    worst = max(compared, key=lambda r: abs(r.difference or 0.0))
    notes = list(dict.fromkeys(note(r) for r in rows))
    text = notes[0] if len(notes) == 1 else note(worst) + " (worst of the series)"
    return PrintedLine(first.where, name, minus(worst.printed.text), *computed_cells(worst), first.status, text)


def check_lines(checks: Sequence[PaperCheck]) -> Iterator[tuple[str, ...]]:
    """Cells of the table of checks: one line per group with the check nearest to its bound or farthest beyond it."""
    for series, group in groupby(checks, key=lambda c: c.series):
        members = list(group)
        worst = max(members, key=lambda c: abs(c.deviation) / c.bound)
        status = "holds" if all(c.status == "holds" for c in members) else "fails"
        yield f"{series}, worst of {len(members)}", *check_cells(worst), status, worst.why


def check_cells(check: PaperCheck) -> tuple[str, str, str, str]:
    """Expected and found value, deviation and bound, with their unit."""
    unit = f" {check.unit}"
    digits = max(0, 1 - math.floor(math.log10(check.bound)))
    given, found = (minus(f"{value:.{digits}f}") + unit for value in (check.expected, check.found))
    return given, found, short(check.deviation) + unit, f"< {short(check.bound)}{unit}"


def _common(units: Iterator[str]) -> str:
    found = set(units)
    return found.pop() if len(found) == 1 else ""


def _unit(unit: str) -> str:
    return f" ({unit})" if unit and unit != "1" else ""


def minus(text: str) -> str:
    """A number in print: a real minus sign unless it is zero, a small e."""
    text = text.replace("E", "e")
    zero = text.startswith("-") and not any(c in "123456789" for c in text.partition("e")[0])
    return text[1:] if zero else text.replace("-", "−")
