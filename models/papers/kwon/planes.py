"""Whether points lie on one plane or on two or three parallel ones: what a grid of commands gives, horizontal, tilted or upright."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.papers.kwon.terms import CUBIC, Exponents, regressors

MOST_PLANES = 3
"""Four planes carry a full cubic, fewer do not (math.md 6)."""
NO_SLOPE = 1e-12
"""Below this a slope is the rounding of its computation."""
STEEPEST = 1.0 + 1e-9
"""Planes are described along an axis that they face: no slope above 1. Every plane has such an axis."""


@dataclass(frozen=True)
class Planes:
    """Parallel planes, one height each.

    Attributes
    ----------
    axis : int
        Coordinate that the planes face: 2 for Z, 1 for Y, 0 for X.
    slope : array, shape (3,)
        Rise of that coordinate per mm of each other one; 0 for the axis itself.
    levels_mm : tuple of float
        Rising values of coordinate - slope . point, 1 to 3 of them.
    """

    axis: int
    slope: F1
    levels_mm: tuple[float, ...]

    def offset_mm(self, points_mm: F2) -> F1:
        """Coordinate - slope . point, shape (n,): on a plane it is that plane's level."""
        result: F1 = points_mm[:, self.axis] - points_mm @ self.slope
        return result

    def snapped(self, points_mm: F2) -> F2:
        """Points moved along the axis onto the nearest plane, shape (n, 3)."""
        levels = np.asarray(self.levels_mm)
        nearest = levels[np.abs(self.offset_mm(points_mm)[:, None] - levels).argmin(axis=1)]
        moved = points_mm.copy()
        moved[:, self.axis] = nearest + points_mm @ self.slope
        return moved

    @property
    def terms(self) -> tuple[Exponents, ...]:
        """Monomials that the planes can tell apart: powers of the axis below the number of planes."""
        return tuple(t for t in CUBIC if t[self.axis] < len(self.levels_mm))

    @property
    def tilt_text(self) -> str:
        """The slope in words, empty for planes square to the axis."""
        return "".join(f" {s:+.4g} {letter}" for s, letter in zip(self.slope, "XYZ", strict=True) if s)


def parallel_planes(points_mm: F2, tolerance_mm: float) -> Planes | None:
    """The fewest parallel planes (at most 3) on which the points lie, or None.

    Parameters
    ----------
    points_mm : array, shape (n, 3)
    tolerance_mm : float
        How far a point may be off its plane along the axis; neighbouring planes must leave a gap of more than twice that.
    """
    for count in range(1, MOST_PLANES + 1):
        for axis in (2, 1, 0):
            for slope in (np.zeros(3), _common_slope(points_mm, axis, count)):
                levels = _levels((points_mm[:, axis] - points_mm @ slope), tolerance_mm, count)
                if levels and np.abs(slope).max() <= STEEPEST:
                    return Planes(axis, slope, levels)
    return None


def _common_slope(points_mm: F2, axis: int, count: int) -> F1:
    """Slope that ``count`` parallel planes would have.

    On planes c = s.p + w_k the product of (c - s.p - w_k) vanishes: c^count is a combination of the monomials with lower powers of c, in
    which (other coordinate) c^(count - 1) has the coefficient count x slope.
    """
    middle = points_mm.mean(axis=0)
    size = float(np.abs(points_mm - middle).max()) or 1.0
    top = _monomial({axis: count})
    lower = tuple(t for t in CUBIC if sum(t) <= count and t[axis] < count)
    x = regressors((points_mm - middle) / size, (*lower, top))
    found = np.linalg.lstsq(x[:, :-1], x[:, -1], rcond=1e-9)[0]
    slope = np.zeros(3)
    for other in {0, 1, 2} - {axis}:
        slope[other] = found[lower.index(_monomial({axis: count - 1, other: 1}))] / count
    return np.where(np.abs(slope) > NO_SLOPE, slope, 0.0)


def _monomial(powers: dict[int, int]) -> Exponents:
    return powers.get(0, 0), powers.get(1, 0), powers.get(2, 0)


def _levels(offset_mm: F1, tolerance_mm: float, count: int) -> tuple[float, ...]:
    """Middle of each group of values, if they form ``count`` groups no wider than twice the tolerance and apart by more; else empty."""
    values = np.sort(offset_mm)
    groups = np.split(values, np.flatnonzero(np.diff(values) > 2.0 * tolerance_mm) + 1)
    if len(groups) != count or any(g[-1] - g[0] > 2.0 * tolerance_mm for g in groups):
        return ()
    return tuple(float(g[0] if g[0] == g[-1] else 0.5 * (g[0] + g[-1])) for g in groups)
