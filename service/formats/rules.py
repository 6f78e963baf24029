"""Rules of every format, checked before a file is written: limits of the control, and the sign.

Sign: e = actual − nominal. A number in a file is ``per_error`` times e, plus the nominal position if the control expects the reached
position. Each format states its `SignRule`; no other code depends on these signs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from abbe.models.arrays import F1
from abbe.models.machine import AXES
from abbe.service.errors import FormatRefused
from abbe.service.formats.model import AxisTable, Compensation

NOTHING = "nothing was written"
PLAUSIBLE_MM = 1.0
"""Largest plausible correction; a larger number has another unit or is not a correction."""
SPACING_TOLERANCE_MM = 1e-6


@dataclass(frozen=True, slots=True)
class FormatLimits:
    """Limits of a format.

    ``points``: largest number per table; ``directional``: a table may differ between the directions of motion; ``size_mm``: largest
    absolute correction; ``own`` to ``motions``: whether the format holds this kind of table; ``lines``: its tables are straight lines;
    ``lost_motion``: it holds a backlash parameter.
    """

    points: int
    equidistant: bool = False
    directional: bool = True
    size_mm: float = PLAUSIBLE_MM
    tables: int | None = None
    own: bool = True
    cross: bool = False
    products: bool = False
    lattice: bool = False
    motions: bool = False
    lines: bool = False
    lost_motion: bool = False
    zero_at_reference: bool = True


def check_kinds(comp: Compensation, limits: FormatLimits, what: str) -> None:
    """Refuse kinds of tables that the format does not support.

    Raises
    ------
    FormatRefused
        The message names the table and the reason.
    """
    for table in comp.tables:
        if not (limits.own if table.own else limits.cross):
            raise FormatRefused(f"{what} cannot hold the table {table.name}", f"choose another format for it; {NOTHING}")
    pairs = [t.name for t in comp.tables] + [p.name for p in comp.products]
    twice = next((n for n in pairs if pairs.count(n) > 1), None)
    if twice is not None:
        raise FormatRefused(f"{what}: there are two tables {twice}", f"add them up; {NOTHING}")
    kinds = (
        (limits.products, bool(comp.products), "products of two tables"),
        (limits.lattice, comp.lattice is not None, "a 3-D grid"),
        (limits.motions, comp.motions is not None, "error motions"),
        (limits.lost_motion, any(comp.lost_motion_mm.values()), "a backlash parameter"),
    )
    for able, there, kind in kinds:
        if there and not able:
            raise FormatRefused(f"{what} cannot hold {kind}", f"choose another format; {NOTHING}")
    if not (comp.tables or comp.products or comp.lattice or comp.motions or any(comp.lost_motion_mm.values())):
        raise FormatRefused(f"{what}: there is nothing to write", "give tables")


def check_table(table: AxisTable, limits: FormatLimits, what: str, reference_mm: tuple[float, float, float] | None, unit_mm: float) -> None:
    """Refuse one table that the format cannot hold.

    Raises
    ------
    FormatRefused
        The message names the limit, and where the table exceeds it.
    """
    name = f"{what}, table {table.name}"
    check_positions(table.position_mm, limits, name)
    for values in (table.forward_mm, table.backward_mm):
        check_size(table.position_mm, values, limits, name)
    if table.directional and not limits.directional:
        raise FormatRefused(
            f"{name}: the two directions of motion differ, and the format holds only one column", f"give the mean of both; {NOTHING}"
        )
    if reference_mm is not None and limits.zero_at_reference:
        here = float(np.interp(reference_mm[AXES.index(table.axis)], table.position_mm, table.forward_mm))
        if abs(here) > 0.5 * unit_mm + 1e-9:
            at = reference_mm[AXES.index(table.axis)]
            raise FormatRefused(
                f"{name}: {here * 1e3:+.3f} µm at the reference ({table.axis} {at:g}), where it must be zero", f"shift the table; {NOTHING}"
            )


def check_positions(position_mm: F1, limits: FormatLimits, name: str) -> None:
    """Check number, order and spacing of a table's points.

    Raises
    ------
    FormatRefused
        The number is outside the limit, positions do not increase, or the spacing is unequal.
    """
    n = position_mm.size
    if not 2 <= n <= limits.points:
        raise FormatRefused(f"{name}: {n} points, the control holds 2 to {limits.points}", f"use fewer or more points; {NOTHING}")
    step = np.diff(position_mm)
    if not np.isfinite(position_mm).all() or not (step > 0).all():
        raise FormatRefused(f"{name}: positions do not increase", f"sort the table; {NOTHING}")
    if limits.equidistant and np.ptp(step) > SPACING_TOLERANCE_MM:
        raise FormatRefused(
            f"{name}: points are {step.min():g} to {step.max():g} mm apart, the control wants equal distances", f"resample it; {NOTHING}"
        )


def check_size(position_mm: F1, values: F1, limits: FormatLimits, name: str) -> None:
    """Refuse values that are not finite or too large for a correction.

    Raises
    ------
    FormatRefused
        The message names place and size.
    """
    if not np.isfinite(values).all():
        raise FormatRefused(f"{name}: the table holds values that are not numbers", f"check the solution; {NOTHING}")
    k = int(np.argmax(np.abs(values)))
    if abs(values[k]) > limits.size_mm:
        raise FormatRefused(
            f"{name}: {values[k]:+.4f} mm at {position_mm[k]:g} mm, the largest allowed is {limits.size_mm:g} mm",
            f"check sign, unit and solution; {NOTHING}",
        )


Evidence = Literal["verified by execution", "by manual"]


@dataclass(frozen=True, slots=True)
class SignRule:
    """Sign rule: the number that a format writes for an error.

    ``per_error``: factor of the error, +1 or −1. ``adds_position``: the nominal position is added. ``sure``: whether a manual states the
    sign explicitly; if none does, verify the 10 µm step (docs/reference/formats.md) on the machine before loading a table.
    """

    per_error: Literal[1, -1]
    adds_position: bool
    evidence: Evidence
    sure: bool
    text: str

    def to_file(self, correction: F1, position_mm: F1) -> F1:
        """Convert corrections at positions of an axis to numbers of a file, mm."""
        value = -self.per_error * np.asarray(correction, dtype=np.float64)
        return value + position_mm if self.adds_position else value

    def from_file(self, number: F1, position_mm: F1) -> F1:
        """Convert numbers of a file to corrections, mm."""
        value = np.asarray(number, dtype=np.float64)
        return -self.per_error * (value - position_mm if self.adds_position else value) + 0.0
