"""The smooth part of nine tables: the part of an active correction that a solver of smooth error motions can recover."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.polynomial import Legendre

from abbe.models.arrays import F1, F2
from abbe.models.compensation.tables import NineTables

WITHIN_MM = 5e-4
"""Largest difference of a smooth table from its polynomial at any position; others are pitch errors, or made by hand."""
ORDERS = range(2, 13)


def smooth_of(tables: NineTables) -> Callable[[F2], F2] | None:
    """Polynomials through nine tables: corrections at commanded positions (n, 3), mm, shape (n, 3); None where there are none such.

    Each table gets the lowest order of 2 to 12 that fits it within 0.5 µm at its positions. The residual comes from interpolation, rounding
    and cut ends, which no error of a machine resembles and a solver would take for motions of high order.
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
    for order in ORDERS:
        if order >= position_mm.size - 1:
            return None
        one = Legendre.fit(position_mm, correction_mm, order)
        if float(np.abs(one(position_mm) - correction_mm).max()) <= WITHIN_MM:
            return one
    return None
