"""Steps of a clock and restarts of a device: samples before and after must never be joined."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from abbe.models.arrays import F1

BLOCKS = 40
LEAST_IN_BLOCK = 10
SURE = 10.0
"""Least step, as a multiple of the scatter of the blocks' least delays."""
LEAST_STEP_S = 1e-3
SIDE = 4
"""Least blocks on either side of a step: fewer late ones at an end are a spike."""


@dataclass(frozen=True, slots=True)
class Break:
    """Between pair ``index - 1`` and ``index`` the device restarted (its time fell) or one of the clocks was set by ``step_s`` of host
    time."""

    index: int
    kind: Literal["restart", "step"]
    step_s: float


def breaks(device_s: F1, arrived_s: F1) -> tuple[Break, ...]:
    """All places where stamps and arrivals contradict a single, evenly running clock, in order.

    A restart: device time falls. A step: the least delays jump to another level and stay there; a spike, however long, comes back.
    """
    x, y = np.asarray(device_s, dtype=np.float64), np.asarray(arrived_s, dtype=np.float64)
    falls = np.flatnonzero(np.diff(x) < 0.0) + 1
    found = [Break(int(k), "restart", float("nan")) for k in falls]
    for a, b in zip([0, *falls], [*falls, x.size], strict=True):
        found += _steps(x[a:b], y[a:b], int(a))
    return tuple(sorted(found, key=lambda one: one.index))


def _steps(x: F1, y: F1, shift: int) -> list[Break]:
    count = min(BLOCKS, x.size // LEAST_IN_BLOCK)
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
    """Two levels with one slope: the first block of the second level, both levels, scatter about them, slope."""

    at: int
    before: float
    after: float
    noise: float
    slope: float

    @property
    def jump(self) -> float:
        return self.after - self.before


def _lowest(x: F1, y: F1) -> int:
    """The earliest arrival of a block, its trend taken out."""
    if x[-1] <= x[0]:
        return int(np.argmin(y))
    trend = (y[-1] - y[0]) / (x[-1] - x[0])
    return int(np.argmin(y - trend * x)) if x.size < 4 else int(np.argmin(y - np.polyfit(x, y, 1)[0] * x))


def _best_split(x: F1, y: F1) -> _Split:
    """Best split into two levels with one slope, by medians, which ignore blocks that arrived late as a whole."""
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
    """The pair at which the level changes, among those of the blocks about it."""
    a, b = around
    hit = np.flatnonzero(rest[a:b] < 0.5 * (split.before + split.after))
    if hit.size == 0:
        return a
    # arrivals come earlier from here on: the first that was not possible before; or later: behind the last that is not possible any more
    return a + (int(hit[0]) if split.jump < 0.0 else int(hit[-1]) + 1)
