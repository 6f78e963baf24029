"""Where to put the cup: the paper's centre of the bed and points about it, and whether the hemispheres fit into the travel (math.md 4.3).

Number and places of the paper's origins (Fig. 6) are lost; centre plus four at (±200, ±75) mm is the plan of the vectors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2

DEFAULT_OFFSETS_MM = ((-200.0, -75.0), (-200.0, 75.0), (200.0, -75.0), (200.0, 75.0))
"""Offsets of the four outer origins in the two axes across the hemisphere's axis (X and Z of the paper's horizontal machine)."""


@dataclass(frozen=True, slots=True)
class OriginFit:
    """Whether a hemisphere fits: how far it leaves the travel at each end of each axis (0 inside), mm, shape (3, 2)."""

    over_mm: F2

    @property
    def ok(self) -> bool:
        """Nothing leaves the travel."""
        return bool((self.over_mm <= 0.0).all())


def origin_plan(stroke_mm: F2, offsets_mm: tuple[tuple[float, float], ...] = DEFAULT_OFFSETS_MM, *, axis: int = 1) -> F2:
    """Origins: the centre of the bed and points about it, shape (1 + len(offsets), 3), mm, in the coordinates of ``stroke_mm``.

    Parameters
    ----------
    stroke_mm : array, shape (3, 2)
        Travel of X, Y, Z.
    offsets_mm : tuple of pairs
        Offsets from the centre along the two axes across ``axis``, in alphabetic order.
    axis : int
        Axis of the hemispheres, 1 = Y: there the origin stands at the small end of the travel.

    Raises
    ------
    ValueError
        ``stroke_mm`` is no finite (3, 2) array of growing pairs, ``axis`` is not 0, 1 or 2, or an origin would lie outside the travel (or
        nowhere). Whether a hemisphere fits about it, `hemisphere_fits` tells.
    """
    stroke = _stroke(stroke_mm, axis)
    centre = stroke.mean(axis=1)
    centre[axis] = stroke[axis, 0]
    across = [a for a in range(3) if a != axis]
    out = np.tile(centre, (1 + len(offsets_mm), 1))
    for k, pair in enumerate(offsets_mm):
        if np.shape(pair) != (2,):
            raise ValueError(f"origins: offset {k + 1} must be two numbers, got {pair!r}")
        out[k + 1, across] += pair
    inside = ((out >= stroke[:, 0]) & (out <= stroke[:, 1])).all(axis=1)
    if not inside.all():
        k = int(np.argmin(inside))
        raise ValueError(f"origins: origin {k} at {', '.join(f'{v:g}' for v in out[k])} mm lies outside the travel, give smaller offsets")
    return out


def hemisphere_fits(origin_mm: F1, radius_mm: float, stroke_mm: F2, *, axis: int = 1) -> OriginFit:
    """Whether a hemisphere about ``origin_mm`` with its pole in +``axis`` stays in the travel.

    Parameters
    ----------
    origin_mm, stroke_mm : array, shape (3,) and (3, 2)
        Scales, mm.
    radius_mm : float

    Raises
    ------
    ValueError
        Radius not positive, origin not three finite numbers, strokes or axis as `origin_plan`.
    """
    stroke = _stroke(stroke_mm, axis)
    if not 0 < radius_mm < np.inf:
        raise ValueError(f"hemisphere: radius {radius_mm} mm must be positive")
    o = np.asarray(origin_mm, dtype=np.float64)
    if o.shape != (3,) or not np.isfinite(o).all():
        raise ValueError(f"hemisphere: the origin must be three finite numbers, got {origin_mm!r}")
    low, high = o - radius_mm, o + radius_mm
    low[axis] = o[axis]
    return OriginFit(np.maximum(np.stack([stroke[:, 0] - low, high - stroke[:, 1]], axis=1), 0.0))


def _stroke(stroke_mm: F2, axis: int) -> F2:
    stroke = np.asarray(stroke_mm, dtype=np.float64)
    if stroke.shape != (3, 2) or not np.isfinite(stroke).all() or not (stroke[:, 1] > stroke[:, 0]).all() or axis not in (0, 1, 2):
        raise ValueError(f"origins: strokes of shape {stroke.shape} must be (3, 2) and growing, axis {axis} one of 0, 1, 2")
    return stroke
