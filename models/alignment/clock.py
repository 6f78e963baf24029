"""Fit of device time to host time with drift, and detection of clock steps and device restarts.

The host knows when a sample arrived, not when the device took it: arrival times are only upper bounds of sample times. Each segment between
two breaks has a fit of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from abbe.models.arrays import F1

# The straight line under a cloud of arrivals: no sample arrives before it was taken, but any may arrive late.


BLOCKS = 200
LOWEST = 24
MANY = 100
"""Number of smallest delays from which the exponent of the delay distribution is estimated; with few points, `LOWEST` delays."""
LEAST_PAIRS = 2 * LOWEST + 2
EARLY = 3.0
"""If an arrival lies below the line of all others by more than this multiple of the 24th smallest delay, its time stamp is wrong."""
MOST_EARLY = 3
STEP_BLOCKS = 40
LEAST_IN_BLOCK = 10
SURE = 10.0
"""Smallest step that is detected, as a multiple of the scatter of the blocks' smallest delays."""
LEAST_STEP_S = 1e-3
SIDE = 4
"""Minimum number of blocks on either side of a step; fewer late blocks at the beginning or end are a spike of the delays."""


@dataclass(frozen=True, slots=True)
class Constants:
    """Table of the error of a line fitted under delays with a power-law distribution, in units of the 24th smallest delay.

    ``shape``: estimated exponents, one per column of the table. ``bias``: height error of the line in its middle. ``half``: half the
    width of the 95.45 % interval of the error in the middle. ``tilt``: half the width of this interval for the rise of the line from end to
    end. Simulated on 40 000 and 60 000 clouds with exponents 0.6 to 4.5 (tests/experiments/campaigns/envelope_constants.py).
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
    """Line ``level + slope (x - middle)`` under a cloud of points, corrected for its bias, with standard uncertainties.

    ``span``: distance from the first to the last x. ``lowest``: indices of the two points on which the line rests.
    """

    middle: float
    level: float
    slope: float
    u_level: float
    u_slope: float
    span: float
    lowest: tuple[int, int]


def lower_envelope(x: F1, y: F1) -> Envelope:
    """Fit the line below all points with the least sum of distances (an edge of the lower convex hull), corrected for its bias.

    Parameters
    ----------
    x, y : array, shape (n,)
        At least 50 points, x rising.

    Raises
    ------
    ValueError
        Fewer points, x that decreases, or values that are not finite.
    """
    if x.size < 2 * LOWEST + 2 or x.shape != y.shape:
        raise ValueError(f"envelope: {x.size} points given, at least {2 * LOWEST + 2} needed")
    if not (np.isfinite(x).all() and np.isfinite(y).all()) or (np.diff(x) < 0.0).any() or x[-1] <= x[0]:
        raise ValueError("envelope: x must rise, and all x and y must be finite")
    middle = 0.5 * float(x[0] + x[-1])
    slope0 = float(np.polyfit(x - middle, y, 1)[0])  # a rough slope first: small residuals lose no digits
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
    """Return the 24th smallest delay, and the exponent a of the smallest delays: the number of delays below d grows as d^a."""
    top, scale = float(lowest.max()), float(np.partition(lowest, LOWEST - 1)[LOWEST - 1])
    if scale <= 0.0:
        return 0.0, 1.0  # all delays are equal: the line has no bias
    logs = np.log(top / np.maximum(lowest, 1e-9 * top))
    return scale, float((lowest.size - 1) / max(float(logs.sum()), 1e-12))


def _edge(x: F1, y: F1) -> tuple[int, int]:
    """Return the end points (indices) of the edge of the lower convex hull that spans the mean of x."""
    some = np.unique([a + int(np.argmin(y[a:b])) for a, b in pairwise(np.linspace(0, x.size, min(BLOCKS, x.size) + 1).astype(int))])
    rough = _hull(x, y, np.unique(np.concatenate([[0], some, [x.size - 1]])))
    # a point above the hull of some points cannot be a corner of the hull of all
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


@dataclass(frozen=True, slots=True)
class ClockFit:
    """Host time as a function of device time: ``host = host_s0 + rate (device - device_s0)``, corrected for the shortest delay.

    ``device_s0`` is the middle of the fitted span. Standard uncertainties: ``u_offset_s`` of ``host_s0``, ``u_rate`` of the rate,
    ``u_delay_s`` of the shortest delay, which arrivals cannot show. ``pairs``: number of arrivals used; ``early``: number of arrivals left
    out because they came impossibly early.
    """

    device_s0: float
    host_s0: float
    rate: float
    u_offset_s: float
    u_rate: float
    u_delay_s: float
    pairs: int
    early: int = 0

    @property
    def drift_ppm(self) -> float:
        """Rate of the device's clock minus the rate of the host's clock, ppm."""
        return (1.0 / self.rate - 1.0) * 1e6

    @property
    def u_drift_ppm(self) -> float:
        """Standard uncertainty of the drift, ppm."""
        return self.u_rate / self.rate**2 * 1e6

    def host_s(self, device_s: F1) -> F1:
        """Return the host time at which the device's clock showed ``device_s``."""
        return np.asarray(self.host_s0 + self.rate * (np.asarray(device_s, dtype=np.float64) - self.device_s0))

    def u_host_s(self, device_s: F1) -> F1:
        """Return the standard uncertainty of `host_s`."""
        away = self.u_rate * (np.asarray(device_s, dtype=np.float64) - self.device_s0)
        return np.sqrt(self.u_offset_s**2 + self.u_delay_s**2 + away**2)

    def device_s(self, host_s: F1) -> F1:
        """Return the device time at a host time."""
        return np.asarray(self.device_s0 + (np.asarray(host_s, dtype=np.float64) - self.host_s0) / self.rate)


def fit_clock(device_s: F1, arrived_s: F1, *, least_delay_s: float = 0.0, u_delay_s: float = 0.0, grid_s: float = 0.0) -> ClockFit:
    """Fit host time over device time to pairs of device time stamp and host arrival time.

    Delays are never negative and have a long tail (adapters collect bytes for 16 ms, the operating system adds spikes). So the line runs
    under all arrivals, not through their middle (Moon, Skelly, Towsley 1999); its bias and uncertainty come from the smallest delays.

    Parameters
    ----------
    device_s, arrived_s : array, shape (n,)
        Device time of a sample (the newest of those that arrived together), and monotonic host time of its arrival. At least 50 pairs from
        one segment, without a restart or a clock step.
    least_delay_s, u_delay_s : float
        Shortest delay of the link itself, which the arrivals do not show, and its standard uncertainty.
    grid_s : float
        If an adapter collects bytes in step with the samples, delays lie on a grid of this width (the greatest common divisor of both
        periods) and hide a slow drift. The uncertainties then include the grid: 0.6 of it over the span for the rate, and a uniform
        distribution from 0 to the grid for the offset.

    Raises
    ------
    ValueError
        Too few pairs, times that do not rise, or values that are not finite.
    """
    x, y = np.asarray(device_s, dtype=np.float64), np.asarray(arrived_s, dtype=np.float64)
    if x.size < LEAST_PAIRS:
        raise ValueError(f"clock: {x.size} pairs of time stamp and arrival, at least {LEAST_PAIRS} are needed")
    early = 0
    found = lower_envelope(x, y)
    while early < MOST_EARLY and x.size > LEAST_PAIRS:
        worst = _too_early(x, y, found.lowest)
        if worst is None:
            break
        x, y, early = np.delete(x, worst), np.delete(y, worst), early + 1
        found = lower_envelope(x, y)
    if not found.slope > 0.0:
        raise ValueError("clock: host time does not rise with device time")
    level = found.level - least_delay_s
    u_level = float(np.hypot(found.u_level, grid_s / np.sqrt(3.0)))
    u_slope = float(np.hypot(found.u_slope, 0.6 * grid_s / found.span))
    return ClockFit(found.middle, level, found.slope, u_level, u_slope, u_delay_s, x.size, early)


def _too_early(x: F1, y: F1, lowest: tuple[int, int]) -> int | None:
    """Return the index of a ``lowest`` point that lies impossibly far below the line under all others, or None."""
    for k in lowest:
        rest_x, rest_y = np.delete(x, k), np.delete(y, k)
        line = lower_envelope(rest_x, rest_y)
        above = rest_y - line.level - line.slope * (rest_x - line.middle)
        top = float(np.partition(above, LOWEST)[LOWEST])
        below = line.level + line.slope * (x[k] - line.middle) - y[k]
        if below > EARLY * max(top, 1e-9) and below > 1e-5:
            return k
    return None


def across(device: ClockFit, other: ClockFit, device_s: F1) -> tuple[F1, F1]:
    """Convert a device's time to the clock of another device through host time; return it with its standard uncertainty."""
    host = device.host_s(device_s)
    there = other.device_s(host)
    u = np.sqrt(device.u_host_s(device_s) ** 2 + other.u_host_s(there) ** 2) / other.rate
    return there, u


def relative_rate(device: ClockFit, other: ClockFit) -> tuple[float, float]:
    """Return the seconds of the other clock per second of the device's clock, and their standard uncertainty."""
    rate = device.rate / other.rate
    return rate, rate * float(np.hypot(device.u_rate / device.rate, other.u_rate / other.rate))


@dataclass(frozen=True, slots=True)
class Break:
    """A break between the pairs ``index - 1`` and ``index``: the device restarted, or a clock stepped by ``step_s`` of host time."""

    index: int
    kind: Literal["restart", "step"]
    step_s: float


def breaks(device_s: F1, arrived_s: F1) -> tuple[Break, ...]:
    """Find all breaks of a device's clock, in order.

    At a restart, device time falls. At a step, the smallest delays jump to another level and stay there; after a spike they return.
    """
    x, y = np.asarray(device_s, dtype=np.float64), np.asarray(arrived_s, dtype=np.float64)
    falls = np.flatnonzero(np.diff(x) < 0.0) + 1
    found = [Break(int(k), "restart", float("nan")) for k in falls]
    for a, b in zip([0, *falls], [*falls, x.size], strict=True):
        found += _steps(x[a:b], y[a:b], int(a))
    return tuple(sorted(found, key=lambda one: one.index))


def _steps(x: F1, y: F1, shift: int) -> list[Break]:
    count = min(STEP_BLOCKS, x.size // LEAST_IN_BLOCK)
    if count < 2 * SIDE:
        return []
    edges = np.linspace(0, x.size, count + 1).astype(int)
    middle, level = x.mean(), float(y[0])
    lows = np.array([a + _lowest(x[a:b] - middle, y[a:b] - level) for a, b in pairwise(edges)])
    split = _best_split(x[lows] - middle, y[lows] - level)
    if abs(split.jump) < max(SURE * split.noise, LEAST_STEP_S):
        return []
    around = int(edges[split.at - 1]), int(edges[min(split.at + 1, count)])
    index = _first_after(y - level - split.slope * (x - middle), around, split)
    here = Break(shift + index, "step", split.jump)
    return [*_steps(x[:index], y[:index], shift), here, *_steps(x[index:], y[index:], shift + index)]


@dataclass(frozen=True, slots=True)
class _Split:
    """Two levels with a common slope: first block of the second level, both levels, scatter about them, slope."""

    at: int
    before: float
    after: float
    noise: float
    slope: float

    @property
    def jump(self) -> float:
        return self.after - self.before


def _lowest(x: F1, y: F1) -> int:
    """Return the index of the earliest arrival of a block, relative to the trend of the block."""
    if x[-1] <= x[0]:
        return int(np.argmin(y))
    trend = (y[-1] - y[0]) / (x[-1] - x[0])
    return int(np.argmin(y - trend * x)) if x.size < 4 else int(np.argmin(y - np.polyfit(x, y, 1)[0] * x))


def _best_split(x: F1, y: F1) -> _Split:
    """Find the best split into two levels with a common slope, by medians, which ignore a block in which all arrivals are late."""
    best, least = _Split(0, 0.0, 0.0, 1.0, 0.0), np.inf
    first, second = np.triu_indices(x.size, 1)
    slopes = (y[second] - y[first]) / (x[second] - x[first])
    for at in range(SIDE, x.size - SIDE + 1):
        slope = float(np.median(slopes[(second < at) | (first >= at)]))
        rest = y - slope * x
        before, after = float(np.median(rest[:at])), float(np.median(rest[at:]))
        left = np.abs(np.concatenate([rest[:at] - before, rest[at:] - after]))
        if left.sum() < least:
            least, best = float(left.sum()), _Split(at, before, after, float(1.4826 * np.median(left)), slope)
    return best


def _first_after(rest: F1, around: tuple[int, int], split: _Split) -> int:
    """Return the index of the pair at which the level changes, within the blocks ``around`` the split."""
    a, b = around
    hit = np.flatnonzero(rest[a:b] < 0.5 * (split.before + split.after))
    if hit.size == 0:
        return a
    # After a jump to earlier: the first arrival impossible before it. After a jump to later: behind the last arrival impossible after it.
    return a + (int(hit[0]) if split.jump < 0.0 else int(hit[-1]) + 1)
