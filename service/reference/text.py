"""Comparisons as lines of text: numbers with their significant digits, whole columns in one line, notes."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

from abbe.service.reference.comparison import Comparison
from abbe.service.reference.printed import FLOAT, OPERANDS, Expected

NONE = "–"
_HYPHEN = re.compile(r"(?<![\w.])-(?=\d)|(?<=\de)-(?=\d)")
"""A hyphen used as a minus sign."""


@dataclass(frozen=True, slots=True)
class TextLine:
    """One line of a table: a comparison, or a whole column whose comparisons have one status."""

    location: str
    quantity: str
    expected: str
    computed: str
    difference: str
    within: str
    status: str
    note: str


def digits_like(value: float, number: Expected) -> str:
    """Return a computed value as text with one digit more than the printed number, in the same notation."""
    text = (number.last or number.text).lower()
    mantissa, _, exponent = text.partition("e")
    decimals = len(mantissa.partition(".")[2]) + 1
    return minus(f"{value:.{decimals}{'e' if exponent else 'f'}}")


def short(value: float) -> str:
    """Return a number as text with at most two significant digits."""
    return minus("0" if value == 0.0 else f"{value:.1e}" if not 1e-3 <= abs(value) < 1e5 else f"{value:.2g}")


def note(row: Comparison) -> str:
    """Return basis and reason of the status, and the effect of the erratum."""
    parts = [part for part in (row.remark, row.why) if part]
    if row.erratum is not None:
        again = ""
        if row.erratum.again is not None:
            again = f": with it {digits_like(row.erratum.again.value, row.expected)}, printed {minus(row.expected.text)}, {row.gap}"
        parts.append(f"erratum: {row.erratum.text}{again}")
    if row.computed is not None and row.computed.because not in ("", OPERANDS):
        parts.append(f"± {row.computed.because}")
    return _HYPHEN.sub("−", "; ".join(parts))


def lines(rows: Sequence[Comparison]) -> Iterator[TextLine]:
    """Yield the lines of a table; neighbouring rows of one series and status become one line with the largest difference."""
    for _, group in groupby(rows, key=lambda r: (r.series, r.status) if r.series else (id(r), r.status)):
        members = list(group)
        yield line_of(members[0]) if len(members) == 1 else _column(members)


def line_of(row: Comparison) -> TextLine:
    """Return the line of one comparison."""
    expected = ("< " if row.expected.bound else "") + minus(row.expected.text)
    return TextLine(row.location, f"{row.quantity}{_unit(row.unit)}", expected, *_computed_cells(row), row.status, note(row))


def _computed_cells(row: Comparison) -> tuple[str, str, str]:
    if row.computed is None or row.difference is None:
        return NONE, NONE, NONE
    within = NONE if row.within is None else short(row.within)
    dust = abs(row.difference) <= FLOAT * max(abs(row.computed.value), abs(row.expected.value))
    return digits_like(row.computed.value, row.expected), short(0.0 if dust else row.difference), within


def _column(rows: list[Comparison]) -> TextLine:
    first = rows[0]
    unit = _unit(_common(r.unit for r in rows))
    name = f"{first.series}{unit}, worst of {len(rows)}"
    compared = [r for r in rows if r.difference is not None and r.computed is not None]
    if not compared:
        return TextLine(first.location, f"{first.series}{unit}", f"{len(rows)} values", NONE, NONE, NONE, first.status, note(first))
    worst = max(compared, key=lambda r: abs(r.difference or 0.0))
    notes = list(dict.fromkeys(note(r) for r in rows))
    text = notes[0] if len(notes) == 1 else note(worst) + " (worst of the series)"
    return TextLine(first.location, name, minus(worst.expected.text), *_computed_cells(worst), first.status, text)


def _common(units: Iterator[str]) -> str:
    found = set(units)
    return found.pop() if len(found) == 1 else ""


def _unit(unit: str) -> str:
    return f" ({unit})" if unit and unit != "1" else ""


def minus(text: str) -> str:
    """Typeset a number: a true minus sign, none for zero, and a small e."""
    text = text.replace("E", "e")
    zero = text.startswith("-") and not any(c in "123456789" for c in text.partition("e")[0])
    return text[1:] if zero else text.replace("-", "−")
