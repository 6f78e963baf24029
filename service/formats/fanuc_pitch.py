"""Fanuc stored pitch error compensation: a file of whole-number steps from point to point, between ``%`` lines.

Point n holds the units added between (n - ref - 1) and (n - ref) intervals from the reference position, so their sum is zero at the
reference (B-63980EN p. 100). The SUMS are rounded and the points hold the differences of rounded sums, so no sum is off by more than half a
unit. For two directions, parameter 3605 bit 0 is 1, 3626 is the first point of the second set, and 3627 the value at the reference when
approached from the other side. The table acts after power off, power on and reference return. Sources differ about the sign and the data
identification of the pitch lines (Q1 here): verify the 10 µm step first (docs/reference/formats.md).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np

from abbe.models.arrays import F1
from abbe.models.machine import AXES
from abbe.service.errors import FormatRefused
from abbe.service.formats.files import FormatSettings, TextFile, integers, short
from abbe.service.formats.model import AxisTable, Compensation
from abbe.service.formats.rules import NOTHING, FormatLimits, SignRule, check_kinds, check_table

LIMITS = FormatLimits(points=129, equidistant=True)
SIGN = SignRule(-1, False, "by manual", False, "pulses that are added from point to point: −Δe; not stated in a manual")
WHAT = "Fanuc pitch error compensation"
NAME = "PITCH.TXT"
LAST_POINT = 1023
BASE = 10000
INPUT_UNIT_MM = 1e-3
"""Unit of a length without a decimal point: 90000 is 90 (in a public tool's file of a rotary table); 50.0 is 50 mm."""
_PARAMETER = re.compile(r"N(\d{5})Q1((?:A\d+P[+-]?[\d.]+)+);?")
_POINT = re.compile(r"N(1\d{4})(?:Q[01])?P([+-]?\d+);?")
_VALUE = re.compile(r"A(\d+)P([+-]?[\d.]+)")
REFERENCE, FIRST, LAST, MAGNIFICATION, INTERVAL, FIRST_BACK, VALUE_BACK, BOTH = 3620, 3621, 3622, 3623, 3624, 3626, 3627, 3605


@dataclass
class _Data:
    """Parameters: (number, axis from 1) -> value and line; points: number -> value and line."""

    parameter: dict[tuple[int, int], tuple[float, int]] = field(default_factory=dict)
    point: dict[int, tuple[int, int]] = field(default_factory=dict)


def write(comp: Compensation, settings: FormatSettings) -> tuple[TextFile, ...]:
    """Write parameters 3605 to 3627 and the points of all axes in one file; ``settings.reference_mm`` is the reference position.

    Raises
    ------
    FormatRefused
        The table is of another kind, has no point at the reference, or has a difference over ``largest_step``; or the control has too few
        points.
    """
    check_kinds(comp, LIMITS, WHAT)
    if settings.reference_mm is None:
        raise FormatRefused(
            f"{WHAT}: positions count from the reference position, which is not given", f"give the reference position; {NOTHING}"
        )
    limits = LIMITS if settings.points is None else FormatLimits(points=settings.points + 1, equidistant=True)
    unit = settings.unit_mm * settings.magnification
    parameters: dict[int, list[str]] = {}
    points: list[str] = []
    free = settings.first_point
    for table in comp.tables:
        check_table(table, limits, WHAT, settings.reference_mm, unit)
        axis, at = AXES.index(table.axis) + 1, _node(table, settings.reference_mm)
        there, back = (
            np.array(integers(SIGN.to_file(v - table.forward_mm[at], table.position_mm), unit))
            for v in (table.forward_mm, table.backward_mm)
        )
        # point n_ref belongs to the section that ends at the reference; the first section's point is the most negative
        first = free
        last = first + table.position_mm.size - 2
        found = {REFERENCE: first + at - 1, FIRST: first, LAST: last, MAGNIFICATION: settings.magnification}
        interval = float(np.ptp(table.position_mm)) / (table.position_mm.size - 1)
        texts = {k: str(v) for k, v in found.items()} | {INTERVAL: short(interval, 6)}
        points += _points(np.diff(there), first, table.name, settings.largest_step)
        free = last + 1
        if table.directional:
            texts |= {BOTH: "1", FIRST_BACK: str(free), VALUE_BACK: str(back[at])}
            points += _points(np.diff(back), free, table.name, settings.largest_step)
            free += table.position_mm.size - 1
        for number, value in texts.items():
            parameters.setdefault(number, []).append(f"A{axis}P{value}")
    if free - 1 > LAST_POINT:
        raise FormatRefused(
            f"{WHAT}: the tables need points up to {free - 1}, the control has 0 to {LAST_POINT}", f"use a coarser grid; {NOTHING}"
        )
    lines = ["%", *(f"N{n:05d}Q1{''.join(v)}" for n, v in sorted(parameters.items())), *points, "%"]
    return (TextFile(NAME, "\n".join(lines) + "\n"),)


def _node(table: AxisTable, reference_mm: tuple[float, float, float]) -> int:
    """Return the index of the point at the reference position."""
    reference = reference_mm[AXES.index(table.axis)]
    at = int(np.argmin(np.abs(table.position_mm - reference)))
    if abs(table.position_mm[at] - reference) > 1e-6:
        raise FormatRefused(f"{WHAT}, table {table.name}: no point at the reference {reference:g} mm", f"choose another grid; {NOTHING}")
    return at


def _points(difference: np.ndarray[tuple[int, ...], np.dtype[np.int64]], first: int, name: str, largest: int) -> list[str]:
    if np.abs(difference).max() > largest:
        k = int(np.abs(difference).argmax())
        raise FormatRefused(
            f"{WHAT}, table {name}: the correction changes by {difference[k]} units from point to point, the control holds ±{largest}",
            f"use more points or a larger magnification; {NOTHING}",
        )
    return [f"N{BASE + first + k}Q1P{v}" for k, v in enumerate(difference)]


def read(files: tuple[TextFile, ...], settings: FormatSettings) -> Compensation:
    """Read the tables as the control would sum them up from the points.

    Raises
    ------
    TableFileError
        A line is neither parameter nor point, the second ``%`` is missing (truncated file), or a parameter or point is missing.
    """
    file = files[0]
    data = _parse(file)
    tables = []
    for axis in sorted({a for n, a in data.parameter if n == FIRST}):
        if not 1 <= axis <= len(AXES):
            raise file.wrong(data.parameter[(FIRST, axis)][1], f"axis A{axis}, expected A1 to A3")
        tables.append(_axis_table(file, data, axis, settings))
    if not tables:
        raise file.wrong(1, f"no parameter {FIRST}: the points belong to no axis")
    return Compensation(tuple(tables))


def _parse(file: TextFile) -> _Data:
    data, percent = _Data(), 0
    for line, text in file.lines():
        bare = text.replace(" ", "")
        if bare.rstrip(";") == "%":
            percent += 1
        elif (m := _POINT.fullmatch(bare)) is not None:
            number = int(m.group(1)) - BASE
            if number in data.point:
                raise file.wrong(line, f"point {number} has a second value (first in line {data.point[number][1]})")
            data.point[number] = (int(m.group(2)), line)
        elif (m := _PARAMETER.fullmatch(bare)) is not None:
            for axis, value in _VALUE.findall(m.group(2)):
                number, found = int(m.group(1)), file.number(line, value, f"parameter {m.group(1)}")
                found *= INPUT_UNIT_MM if number == INTERVAL and "." not in value else 1.0
                data.parameter[(number, int(axis))] = (found, line)
        elif bare:
            raise file.wrong(line, f"{text.strip()!r} is neither a parameter nor a point")
    if percent != 2:
        raise file.wrong(len(file.text.splitlines()), "the file does not end with %: it is cut off")
    return data


def _axis_table(file: TextFile, data: _Data, axis: int, settings: FormatSettings) -> AxisTable:
    def value(number: int) -> float:
        if (number, axis) not in data.parameter:
            raise file.wrong(1, f"parameter {number} of axis {axis} is missing: the control keeps its old value")
        return data.parameter[(number, axis)][0]

    first, last, reference = int(value(FIRST)), int(value(LAST)), int(value(REFERENCE))
    if not (first <= last and first - 1 <= reference <= last and value(INTERVAL) > 0):
        raise file.wrong(
            data.parameter[(FIRST, axis)][1],
            f"points {first} to {last}, point {reference} at the reference and interval {value(INTERVAL):g} mm contradict each other",
        )
    start = 0.0 if settings.reference_mm is None else settings.reference_mm[axis - 1]
    position = start + value(INTERVAL) * (np.arange(first - 1, last + 1, dtype=np.float64) - reference)
    unit = settings.unit_mm * value(MAGNIFICATION)
    there = _sums(file, data, first, last, reference, 0.0)
    back = there
    if data.parameter.get((BOTH, axis), (0.0, 0))[0] == 1:
        begin = int(value(FIRST_BACK))
        back = _sums(file, data, begin, begin + last - first, begin + reference - first, value(VALUE_BACK))
    table = AXES[axis - 1]
    return AxisTable(table, table, position, SIGN.from_file(there * unit, position), SIGN.from_file(back * unit, position))


def _sums(file: TextFile, data: _Data, first: int, last: int, reference: int, at_reference: float) -> F1:
    """Add up points ``first`` to ``last`` of a set into the correction at each position, in units of the control.

    There is one position more than points. ``at_reference``: the correction at the point with the number ``reference``.
    """
    for n in range(first, last + 1):
        if n not in data.point:
            raise file.wrong(1, f"point {n} is missing: the control keeps its old value")
    total = np.concatenate([[0.0], np.cumsum([data.point[n][0] for n in range(first, last + 1)])])
    return np.asarray(total - total[reference - first + 1] + at_reference)
