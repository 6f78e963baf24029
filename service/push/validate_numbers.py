"""Reasons against the numbers of a table: what no number may be, what is too large or too steep, what would not help. Pure."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from itertools import pairwise

from abbe.service.push.candidate import Candidate, CandidateContext, Column
from abbe.service.push.limits import PushLimits

LARGEST = 32767
WHOLE = 0.01
"""How far from a whole unit of the table a value may be: float noise only, so that rounding it costs nothing more."""
ZERO_MM = 0.5e-6
"""A table that is not zero at its reference moves the axis at once when it comes into force."""


def number_reasons(candidate: Candidate, scene: CandidateContext, limits: PushLimits) -> Iterator[str]:
    """All reasons against the numbers of a candidate whose form is right."""
    odd = [reason for column in candidate.columns if (reason := _odd(column))]
    if odd:
        yield from odd
        return
    lsb_mm = scene.lsb_nm * 1e-6
    for column in candidate.columns:
        name = f"table of {column.corrected} over {column.moved}"
        active = scene.active.get((column.moved, column.corrected)) or (0.0,) * len(column.correction_mm)
        for reason in _size(column, active, limits, lsb_mm):
            yield f"{reason} ({name})"
    for axis in sorted({column.corrected for column in candidate.columns}):
        total_mm = sum(max(abs(v) for v in column.correction_mm) for column in candidate.columns if column.corrected == axis)
        yield from together_reasons(axis, total_mm, limits)
    yield from _whole(candidate, scene, limits)


def _odd(column: Column) -> str:
    for value in (*column.correction_mm, *column.reverse_mm, *column.left_mm, *column.position_mm):
        if not math.isfinite(value):
            return f"NUMBER: {value} is none (table of {column.corrected} over {column.moved})"
        if value == 0.0 and math.copysign(1.0, value) < 0.0:
            return f"NUMBER: minus zero (table of {column.corrected} over {column.moved})"
        if value != 0.0 and abs(value) < sys.float_info.min:
            return f"NUMBER: {value} is too small to be one (table of {column.corrected} over {column.moved})"
    return ""


def size_reasons(p: Sequence[float], v: Sequence[float], active: Sequence[float], limits: PushLimits) -> Iterator[str]:
    """What is too large or changes too much in one table: where, by how much, and the key of the machine file that limits it.

    Parameters
    ----------
    p, v, active : sequence of float
        Positions; corrections there, new and in force. Millimetres.
    limits : PushLimits
        What is allowed.
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
    """Whether the three tables of an axis, each at its largest, reach too far; ``total_mm``: the sum of those."""
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
    """The difference of the two directions has to take away what was measured, not to double it."""
    table = sum(b - a for a, b in zip(column.correction_mm, column.reverse_mm, strict=True)) / len(column.reverse_mm)
    if abs(column.reversal_mm + table) > abs(column.reversal_mm):
        seen_um, made_um = column.reversal_mm * 1e3, table * 1e3
        yield f"DIRECTIONS: the two columns are exchanged (measured {seen_um:.1f} µm, the table adds {made_um:.1f} µm)"


def _whole(c: Candidate, scene: CandidateContext, limits: PushLimits) -> Iterator[str]:
    """Shadow simulation: the residual with the new table, from what was measured with the one in force."""
    values = [x for column in c.columns for x in column.correction_mm]
    active = [x for column in c.columns for x in _active(column, scene)]
    if values == active:
        yield "SAME: this table is in force already"
        return
    if not any(values) and any(active):
        yield "ZERO: it would only take the table in force away; that is a rollback"
    left = [x for column in c.columns for x in column.left_mm]
    if len(left) != len(values) or len(active) != len(values):
        yield "RESIDUAL: what the machine shows was not given, so nothing can be predicted"
        return
    after = [e + (new - old) for e, new, old in zip(left, values, active, strict=True)]
    before_mm, after_mm = _rms(left), _rms(after)
    if not after_mm <= (1.0 - limits.gain) * before_mm:
        opposed = sum(e * (new - old) for e, new, old in zip(left, values, active, strict=True)) > 0.0
        word = "SIGN: it adds to the error" if opposed else "GAIN: it takes too little of the error"
        yield f"{word}: {before_mm * 1e3:.2f} to {after_mm * 1e3:.2f} µm rms in the shadow"


def _active(column: Column, scene: CandidateContext) -> tuple[float, ...]:
    return scene.active.get((column.moved, column.corrected)) or (0.0,) * len(column.correction_mm)


def _rms(values: list[float]) -> float:
    return math.sqrt(sum(v * v for v in values) / len(values))
