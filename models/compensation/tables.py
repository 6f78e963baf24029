"""Nine one-axis tables: correction of each axis as a function of each axis, on the controller's grid.

The best nine tables approximate the deviation field by a sum of functions of one axis (`abbe.models.compensation.additive`). The effect of
angles at a lever that depends on two axes remains; a 3-D grid (`abbe.models.compensation.grid`) corrects it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.machine import AXES, Machine

if TYPE_CHECKING:
    from numpy.polynomial import Legendre


@dataclass(frozen=True)
class NineTables:
    """Corrections added to the command: ``correction_mm[a][:, i]`` is added to axis i at the positions ``position_mm[a]`` of axis a.

    ``u_mm``, of the same shapes: standard uncertainty of each entry relative to the first one of its table, from all sources
    (`abbe.models.uncertainty.sources`), in the frame without rigid motion over the volume (docs/explanation/conventions.md, "Frame"). The
    slope of a cross table is partly a rotation of the whole frame. No reading shows this rotation, the rotation changes no distance on a
    part, and its value here is arbitrary: remove the best-fit rotation before you compare tables.
    """

    position_mm: tuple[F1, F1, F1]
    correction_mm: tuple[F2, F2, F2]
    u_mm: tuple[F2, F2, F2]

    def correction_at(self, axes_mm: F2) -> F2:
        """Return the correction at commanded positions, mm, shape (n, 3): linear, constant beyond the grid."""
        out = np.zeros((axes_mm.shape[0], 3))
        for a in range(3):
            for i in range(3):
                out[:, i] += np.interp(axes_mm[:, a], self.position_mm[a], self.correction_mm[a][:, i])
        return out


def grid_positions(machine: Machine, counts: tuple[int, int, int]) -> tuple[F1, F1, F1]:
    """Return an equidistant grid per axis over its stroke; the pitch is rounded down to 10 nm, so that the controller stores it exactly."""
    grids = []
    for a, n in enumerate(counts):
        if n < 2:
            raise ValueError(f"table grid of {AXES[a]}: {n} points given, at least 2 needed")
        pitch = np.floor(machine.length_mm[a] / (n - 1) * 1e5) / 1e5
        grids.append(machine.stroke_mm[a, 0] + pitch * np.arange(n))
    return grids[0], grids[1], grids[2]


def quantise(tables: NineTables, lsb_mm: float) -> NineTables:
    """Return the tables as the controller stores them: every entry rounded to the controller's unit.

    Raises
    ------
    ValueError
        The unit is not a positive number.
    """
    check_unit(lsb_mm)
    rounded = tuple(np.round(c / lsb_mm) * lsb_mm for c in tables.correction_mm)
    return NineTables(tables.position_mm, (rounded[0], rounded[1], rounded[2]), tables.u_mm)


def check_unit(lsb_mm: float) -> None:
    """Refuse a controller's unit that is not a positive number, because entries cannot be rounded to it."""
    if not (np.isfinite(lsb_mm) and lsb_mm > 0):
        raise ValueError(f"tables: the controller's unit is {lsb_mm} mm, but must be a positive number")


@dataclass(frozen=True, slots=True)
class Predicted:
    """Predicted volumetric rms error (rigid motion removed) before and after correction, and `model_uncertainty_mm`, mm."""

    before_mm: float
    after_mm: float
    u_model_mm: float


WITHIN_MM = 5e-4
"""Largest difference, mm, between a smooth table and its polynomial; tables that differ more contain pitch errors or manual entries."""
ORDERS = range(2, 13)


def smooth_of(tables: NineTables) -> Callable[[F2], F2] | None:
    """Fit polynomials to nine tables; return the correction (n, 3), mm, as a function of positions (n, 3), or None if a fit fails.

    Each table gets the lowest order from 2 to 12 that fits its entries within 0.5 µm. The polynomials have neither
    corners between the entries nor rounding, which a solver would take for motions of high order.
    """
    found = [[_meets(tables.position_mm[a], tables.correction_mm[a][:, i]) for i in range(3)] for a in range(3)]
    if any(one is None for row in found for one in row):
        return None
    whole = [[one for one in row if one is not None] for row in found]

    def correction_mm(axes_mm: F2) -> F2:
        inside = [np.clip(axes_mm[:, a], tables.position_mm[a][0], tables.position_mm[a][-1]) for a in range(3)]
        return np.stack([sum((whole[a][i](inside[a]) for a in range(3)), np.zeros(len(axes_mm))) for i in range(3)], axis=1)

    return correction_mm


def _meets(position_mm: F1, correction_mm: F1) -> Legendre | None:
    from numpy.polynomial import Legendre

    for order in ORDERS:
        if order >= position_mm.size - 1:
            return None
        one = Legendre.fit(position_mm, correction_mm, order)
        if float(np.abs(one(position_mm) - correction_mm).max()) <= WITHIN_MM:
            return one
    return None
