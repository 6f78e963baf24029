"""Reasons against the numbers of a table: invalid, too large or too steep, or of no use. Pure."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from itertools import pairwise

from abbe.service.push.candidate import Candidate, CandidateContext, Column
from abbe.service.push.limits import PushLimits

LARGEST = 32767
WHOLE = 0.01
"""Allowed distance of a value from a whole unit of the table, in units: float noise only."""
ZERO_MM = 0.5e-6
"""A table that is not zero at its reference moves the axis at once when it comes into force."""


def number_reasons(candidate: Candidate, context: CandidateContext, limits: PushLimits) -> Iterator[str]:
    """All reasons against the numbers of a candidate of correct form."""
    odd = [reason for column in candidate.columns if (reason := _odd(column))]
    if odd:
        yield from odd
        return
    lsb_mm = context.lsb_nm * 1e-6
    for column in candidate.columns:
        name = f"table of {column.corrected} over {column.moved}"
        active = context.active.get((column.moved, column.corrected)) or (0.0,) * len(column.correction_mm)
        for reason in _size(column, active, limits, lsb_mm):
            yield f"{reason} ({name})"
    for axis in sorted({column.corrected for column in candidate.columns}):
        total_mm = sum(max(abs(v) for v in column.correction_mm) for column in candidate.columns if column.corrected == axis)
        yield from together_reasons(axis, total_mm, limits)
    yield from _whole(candidate, context, limits)


def _odd(column: Column) -> str:
    for value in (*column.correction_mm, *column.reverse_mm, *column.left_mm, *column.position_mm):
        if not math.isfinite(value):
            return f"NUMBER: {value} is not finite (table of {column.corrected} over {column.moved})"
        if value == 0.0 and math.copysign(1.0, value) < 0.0:
            return f"NUMBER: minus zero (table of {column.corrected} over {column.moved})"
        if value != 0.0 and abs(value) < sys.float_info.min:
            return f"NUMBER: {value} is denormal (table of {column.corrected} over {column.moved})"
    return ""


def size_reasons(p: Sequence[float], v: Sequence[float], active: Sequence[float], limits: PushLimits) -> Iterator[str]:
    """Values, changes, steps and bends of one table beyond the limits: each with its place, its size and the key of its limit.

    ``p``, ``v``, ``active``: positions, new corrections and those in force, mm.
    """
    steps = [b - a for a, b in pairwise(v)]
    changes = [a - b for a, b in zip(v, active, strict=True)]
    bends = [b - a for a, b in pairwise(steps)]
    for word, sizes, limit, key in (
        ("VALUE", v, limits.value_mm, "table_value_um"),
        ("CHANGE", changes, limits.change_mm, "table_change_um"),
        ("STEP", steps, limits.step_mm, "table_step_um"),
        ("BEND", bends, limits.second_mm, ""),
    ):
        k = max(range(len(sizes)), key=lambda n: abs(sizes[n]), default=0)
        if sizes and abs(sizes[k]) > limit:
            allowed = f"allowed are {limit * 1e3:.1f} µm" + (f" ([limits] {key})" if key else "")
            yield f"{word}: {abs(sizes[k]) * 1e3:.1f} µm at {p[k]:.1f} mm, {allowed}"


def together_reasons(axis: str, total_mm: float, limits: PushLimits) -> Iterator[str]:
    """The reason if the largest values of an axis' three tables add up to too much; ``total_mm``: their sum."""
    if total_mm > limits.value_mm:
        allowed = f"allowed are {limits.value_mm * 1e3:.1f} µm ([limits] table_value_um)"
        yield f"VALUE: the tables of {axis} together reach {total_mm * 1e3:.1f} µm, {allowed}"


def _size(column: Column, active: tuple[float, ...], limits: PushLimits, lsb_mm: float) -> Iterator[str]:
    v, p = column.correction_mm, column.position_mm
    counts = max(abs(x) / lsb_mm for x in v)
    if round(counts) > LARGEST:
        yield f"OVERFLOW: {counts:.0f} units do not fit 16 bits"
    if len(active) != len(v):
        yield "CHANGE: the table in force has another grid and was not given on this one"
        return
    yield from size_reasons(p, v, active, limits)
    slopes = [abs(d - c) / (b - a) for c, d, a, b in zip(v, v[1:], p, p[1:], strict=False)]
    if max(slopes) > limits.slope:
        yield f"SLOPE: {max(slopes) * 1e3:.2f} µm/mm, allowed are {limits.slope * 1e3:.2f} µm/mm"
    if abs(v[0]) > ZERO_MM:
        yield f"REFERENCE: {v[0] * 1e3:.2f} µm at the reference instead of 0"
    if max(abs(x / lsb_mm - round(x / lsb_mm)) for x in v) > WHOLE:
        yield "ROUNDING: values are no whole units of the table; quantise it first"
    if column.reverse_mm:
        yield from _reverse(column)


def _reverse(column: Column) -> Iterator[str]:
    """The difference of the two directions has to reduce the measured reversal, not to double it."""
    table = sum(b - a for a, b in zip(column.correction_mm, column.reverse_mm, strict=True)) / len(column.reverse_mm)
    if abs(column.reversal_mm + table) > abs(column.reversal_mm):
        measured_um, table_um = column.reversal_mm * 1e3, table * 1e3
        yield f"DIRECTIONS: the two columns are exchanged (measured {measured_um:.1f} µm, the table adds {table_um:.1f} µm)"


def _whole(c: Candidate, context: CandidateContext, limits: PushLimits) -> Iterator[str]:
    """Shadow simulation: predict the residual with the new table from measurements with the one in force."""
    values = [x for column in c.columns for x in column.correction_mm]
    active = [x for column in c.columns for x in _active(column, context)]
    if values == active:
        yield "SAME: this table is in force already"
        return
    if not any(values) and any(active):
        yield "ZERO: it would only take the table in force away; that is a rollback"
    left = [x for column in c.columns for x in column.left_mm]
    if len(left) != len(values) or len(active) != len(values):
        yield "RESIDUAL: the machine's residuals are missing, so nothing can be predicted"
        return
    after = [e + (new - old) for e, new, old in zip(left, values, active, strict=True)]
    before_mm, after_mm = _rms(left), _rms(after)
    if not after_mm <= (1.0 - limits.gain) * before_mm:
        opposed = sum(e * (new - old) for e, new, old in zip(left, values, active, strict=True)) > 0.0
        word = "SIGN: it adds to the error" if opposed else "GAIN: it takes too little of the error"
        yield f"{word}: {before_mm * 1e3:.2f} to {after_mm * 1e3:.2f} µm rms in the shadow"


def _active(column: Column, context: CandidateContext) -> tuple[float, ...]:
    return context.active.get((column.moved, column.corrected)) or (0.0,) * len(column.correction_mm)


def _rms(values: list[float]) -> float:
    return math.sqrt(sum(v * v for v in values) / len(values))
