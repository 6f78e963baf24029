"""Common model of all exported tables (corrections added to the command), and one function that acts as a control would.

A machine that goes too far by e needs the correction −e (docs/explanation/conventions.md).
Tables are piecewise linear with their end values held.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from abbe.models.arrays import F1, F2, F4
from abbe.models.compensation.grid import trilinear
from abbe.models.functions.motions import PLACES, SQUARENESS
from abbe.models.geometry.chain import deviation_mm, squareness_motions
from abbe.models.machine import AXES, Machine

Lookup = Literal["command", "corrected"]
"""Position at which cross, product and grid tables are looked up: the command, or the command corrected by the own-axis tables."""


@dataclass(frozen=True, eq=False)
class AxisCurve:
    """A function of the position of one axis: ``value`` at increasing ``position_mm`` of ``axis`` (X, Y, Z)."""

    axis: str
    position_mm: F1
    value: F1

    def at(self, axes_mm: F2) -> F1:
        """Return the values at positions, shape (n, 3) -> (n,)."""
        return np.interp(axes_mm[:, AXES.index(self.axis)], self.position_mm, self.value)


@dataclass(frozen=True, eq=False)
class AxisTable:
    """Correction of ``output`` as a function of ``axis``, mm: while ``axis`` moves in + (``forward_mm``) and in − (``backward_mm``)."""

    axis: str
    output: str
    position_mm: F1
    forward_mm: F1
    backward_mm: F1

    @property
    def name(self) -> str:
        """Name in messages: ``Y over X``."""
        return f"{self.output} over {self.axis}"

    @property
    def own(self) -> bool:
        """Whether the axis that moves is the one that is corrected: a table of positioning errors."""
        return self.axis == self.output

    @property
    def directional(self) -> bool:
        """Whether the two directions differ."""
        return not np.array_equal(self.forward_mm, self.backward_mm)

    def at(self, axes_mm: F2, direction: F2) -> F1:
        """Return the correction at positions for a ``direction`` of motion (+1, −1; 0: the mean of both), shape (n, 3) each -> (n,)."""
        a = AXES.index(self.axis)
        there = np.interp(axes_mm[:, a], self.position_mm, self.forward_mm)
        back = np.interp(axes_mm[:, a], self.position_mm, self.backward_mm)
        return np.asarray(0.5 * (1.0 + direction[:, a]) * there + 0.5 * (1.0 - direction[:, a]) * back)


@dataclass(frozen=True, eq=False)
class ProductTable:
    """Correction of ``output`` = ``angle`` (rad) times ``lever`` (mm): the effect of a carriage's rotation at a distance."""

    output: str
    angle: AxisCurve
    lever: AxisCurve

    @property
    def name(self) -> str:
        """Name in messages: ``X over Z times Y``."""
        return f"{self.output} over {self.angle.axis} times {self.lever.axis}"


@dataclass(frozen=True, eq=False)
class Lattice:
    """Corrections at the nodes of a 3-D grid, mm, shape (nx, ny, nz, 3); trilinear between nodes."""

    position_mm: tuple[F1, F1, F1]
    correction_mm: F4


@dataclass(frozen=True, eq=False)
class Motions:
    """ERROR motions (ISO 230-1, not corrections; mm, rad) for a control that computes the deviation by its own kinematic chain."""

    machine: Machine
    curves: Mapping[str, AxisCurve]
    squareness_rad: Mapping[str, float]

    def correction_at(self, axes_mm: F2) -> F2:
        """Return minus the deviation that the chain gives (rule G of docs/explanation/conventions.md), mm, shape (n, 3).

        Squareness counts travel from the start of the stroke.
        """
        values = np.zeros((axes_mm.shape[0], 3, 6))
        for name, curve in self.curves.items():
            axis, component = PLACES[name]
            values[:, axis, component] = curve.at(axes_mm)
        angles = np.array([self.squareness_rad.get(name, 0.0) for name in SQUARENESS])
        values += squareness_motions(axes_mm, self.machine.stroke_mm[:, 0]) @ angles
        return -deviation_mm(self.machine, axes_mm, values)


@dataclass(frozen=True, eq=False)
class Compensation:
    """All tables of a machine; the control adds up their corrections.

    ``lost_motion_mm``: the control's backlash parameter B per axis; it adds nothing while the axis moves in +, and −B while it moves in −.
    """

    tables: tuple[AxisTable, ...] = ()
    products: tuple[ProductTable, ...] = ()
    lattice: Lattice | None = None
    motions: Motions | None = None
    lost_motion_mm: Mapping[str, float] = field(default_factory=dict)

    @property
    def own(self) -> tuple[AxisTable, ...]:
        """The own-axis tables."""
        return tuple(t for t in self.tables if t.own)

    @property
    def cross(self) -> tuple[AxisTable, ...]:
        """The tables that correct one axis as a function of another."""
        return tuple(t for t in self.tables if not t.own)

    @property
    def numbers(self) -> int:
        """Count of numbers in all tables."""
        size = sum(t.position_mm.size * (2 if t.directional else 1) for t in self.tables)
        size += sum(p.angle.value.size + p.lever.value.size for p in self.products)
        size += 0 if self.lattice is None else int(self.lattice.correction_mm.size)
        if self.motions is not None:
            size += sum(c.value.size for c in self.motions.curves.values()) + len(self.motions.squareness_rad)
        return size


def negated(comp: Compensation) -> Compensation:
    """Return all tables with the other sign; the backlash parameter stays."""
    tables = tuple(replace(t, forward_mm=-t.forward_mm, backward_mm=-t.backward_mm) for t in comp.tables)
    products = tuple(replace(p, angle=replace(p.angle, value=-p.angle.value)) for p in comp.products)
    lattice = None if comp.lattice is None else replace(comp.lattice, correction_mm=-comp.lattice.correction_mm)
    motions = comp.motions
    if motions is not None:
        curves = {n: replace(c, value=-c.value) for n, c in motions.curves.items()}
        motions = replace(motions, curves=curves, squareness_rad={n: -v for n, v in motions.squareness_rad.items()})
    return Compensation(tables, products, lattice, motions, comp.lost_motion_mm)


def correction_at(comp: Compensation, axes_mm: F2, direction: F2 | None = None, *, lookup: Lookup = "command") -> F2:
    """Return the correction that a control adds to commanded positions; every format must reproduce it.

    Parameters
    ----------
    axes_mm : array, shape (n, 3)
        Commanded positions.
    direction : array, shape (n, 3), optional
        Direction of motion of each axis, +1 or −1; None: the mean of both.
    lookup : "command" or "corrected"
        Position at which all tables but the own-axis ones are looked up (`Lookup`).

    Returns
    -------
    array, shape (n, 3), mm
    """
    way = np.zeros(axes_mm.shape) if direction is None else direction
    out = np.zeros(axes_mm.shape)
    for table in comp.own:
        out[:, AXES.index(table.output)] += table.at(axes_mm, way)
    for axis, lost in comp.lost_motion_mm.items():
        out[:, AXES.index(axis)] -= 0.5 * (1.0 - way[:, AXES.index(axis)]) * lost
    there = axes_mm + out if lookup == "corrected" else axes_mm
    for table in comp.cross:
        out[:, AXES.index(table.output)] += table.at(there, way)
    for product in comp.products:
        out[:, AXES.index(product.output)] += product.angle.at(there) * product.lever.at(there)
    if comp.lattice is not None:
        out += trilinear(comp.lattice.position_mm, comp.lattice.correction_mm, there)
    if comp.motions is not None:
        out += comp.motions.correction_at(there)
    return out
