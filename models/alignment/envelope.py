"""The straight line under a cloud of arrivals: nothing arrives before it was sampled, but anything may arrive late."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from abbe.models.arrays import F1

BLOCKS = 200
LOWEST = 24
MANY = 100
"""How the delays thin out towards the least possible one is estimated from so many of the least; from the fewer where there are few."""


@dataclass(frozen=True, slots=True)
class Constants:
    """Of the line under delays whose number grows like a power of the delay, over the 24th least delay, by the estimated power.

    ``bias``: how far it lies too high in the middle; ``half`` and ``tilt``: half the width of 95.45 % of its error there, and of its rise
    from end to end. Counted on 40 000 and 60 000 clouds with powers 0.6 to 4.5 (tests/campaigns/envelope_constants.py).
    """

    shape: tuple[float, ...]
    bias: tuple[float, ...]
    half: tuple[float, ...]
    tilt: tuple[float, ...]


FEW_DELAYS = Constants(
    (0.627, 0.753, 0.851, 0.951, 1.049, 1.15, 1.273, 1.423, 1.616, 1.866, 2.203, 2.693, 3.35),
    (0.0317, 0.0575, 0.1024, 0.1582, 0.2401, 0.2966, 0.3651, 0.4407, 0.4964, 0.5307, 0.5558, 0.5487, 0.5171),
    (0.0783, 0.1408, 0.2985, 0.5024, 0.7639, 0.819, 0.8375, 0.829, 0.7908, 0.7638, 0.6848, 0.5835, 0.5009),
    (0.2889, 0.4599, 0.6786, 0.8128, 1.0813, 1.2424, 1.3324, 1.3862, 1.3641, 1.3876, 1.3178, 1.2017, 1.1508),
)
MANY_DELAYS = Constants(
    (0.643, 0.751, 0.849, 0.95, 1.049, 1.15, 1.275, 1.425, 1.624, 1.872, 2.21, 2.685, 3.211),
    (0.0252, 0.0363, 0.0547, 0.078, 0.1106, 0.1463, 0.2124, 0.3093, 0.4728, 0.6161, 0.6531, 0.5919, 0.4782),
    (0.058, 0.0793, 0.1154, 0.1447, 0.2141, 0.2778, 0.4005, 0.57, 0.8882, 0.8937, 0.6854, 0.4879, 0.3632),
    (0.3384, 0.4039, 0.5021, 0.6374, 0.715, 0.8816, 1.0444, 1.2063, 1.4307, 1.5989, 1.4401, 1.2249, 0.9504),
)


@dataclass(frozen=True, slots=True)
class Envelope:
    """Line ``level + slope (x - middle)`` under the cloud, its bias taken off; uncertainties are standard ones (half of 95 %).

    ``span``: from the first to the last x. ``lowest``: indices of the two points that it rests on.
    """

    middle: float
    level: float
    slope: float
    u_level: float
    u_slope: float
    span: float
    lowest: tuple[int, int]


def lower_envelope(x: F1, y: F1) -> Envelope:
    """The line below all points with the least sum of distances to them (an edge of the lower convex hull), corrected for what it lies
    high.

    Parameters
    ----------
    x, y : array, shape (n,)
        At least 50 points, x rising.

    Raises
    ------
    ValueError
        Fewer points, x not rising, or numbers that are none.
    """
    if x.size < 2 * LOWEST + 2 or x.shape != y.shape:
        raise ValueError(f"envelope: {x.size} points, at least {2 * LOWEST + 2} are needed")
    if not (np.isfinite(x).all() and np.isfinite(y).all()) or (np.diff(x) < 0.0).any() or x[-1] <= x[0]:
        raise ValueError("envelope: x must rise and all be finite numbers")
    middle = 0.5 * float(x[0] + x[-1])
    slope0 = float(np.polyfit(x - middle, y, 1)[0])  # rough: what is left is small, so that nothing is lost to rounding
    left, rest = x - middle, y - y[0] - slope0 * (x - middle)
    i, k = _edge(left, rest)
    slope = float((rest[k] - rest[i]) / (left[k] - left[i]))
    level = float(rest[i] - slope * left[i])
    above = rest - level - slope * left
    above[[i, k]] = np.inf
    count, table = (MANY, MANY_DELAYS) if x.size >= 4 * MANY else (LOWEST, FEW_DELAYS)
    scale, shape = _edge_of_delays(np.partition(above, count - 1)[:count])
    bias, half, tilt = (float(np.interp(shape, table.shape, c)) * scale for c in (table.bias, table.half, table.tilt))
    span = float(x[-1] - x[0])
    return Envelope(middle, level - bias + float(y[0]), slope + slope0, 0.5 * half, 0.5 * tilt / span, span, (i, k))


def _edge_of_delays(lowest: F1) -> tuple[float, float]:
    """The 24th least delay, and with what power of the delay their number grows."""
    top, scale = float(lowest.max()), float(np.partition(lowest, LOWEST - 1)[LOWEST - 1])
    if scale <= 0.0:
        return 0.0, 1.0  # all delays are the same: the line lies where it should
    logs = np.log(top / np.maximum(lowest, 1e-9 * top))
    return scale, float((lowest.size - 1) / max(float(logs.sum()), 1e-12))


def _edge(x: F1, y: F1) -> tuple[int, int]:
    """The edge of the lower convex hull over the mean of x, as two indices."""
    some = np.unique([a + int(np.argmin(y[a:b])) for a, b in pairwise(np.linspace(0, x.size, min(BLOCKS, x.size) + 1).astype(int))])
    rough = _hull(x, y, np.unique(np.concatenate([[0], some, [x.size - 1]])))
    # what lies above the hull of some of the points is no corner of the hull of all
    hull = _hull(x, y, np.flatnonzero(y <= np.interp(x, x[rough], y[rough]) + 1e-15))
    at = int(np.searchsorted(x[hull], x.mean())) - 1
    at = min(max(at, 0), len(hull) - 2)
    return hull[at], hull[at + 1]


def _hull(x: F1, y: F1, among: np.ndarray[tuple[int, ...], np.dtype[np.intp]]) -> list[int]:
    hull: list[int] = []
    for i in map(int, among):
        while len(hull) > 1 and _above(x, y, hull[-2], hull[-1], i):
            hull.pop()
        if not hull or x[i] > x[hull[-1]]:
            hull.append(i)
        elif y[i] < y[hull[-1]]:
            hull[-1] = i
    return hull


def _above(x: F1, y: F1, a: int, b: int, c: int) -> bool:
    return bool((y[b] - y[a]) * (x[c] - x[a]) >= (y[c] - y[a]) * (x[b] - x[a]))
