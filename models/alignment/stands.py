"""Where a stream stands still, and from which side it came there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1

CLEAR = 6.0
"""A difference of two samples beyond this many of its standard deviations is motion."""
RESOLVED = 1e-6
LEAST_SAMPLES = 4
OVERSHOOT, OVERSHOOT_MM = 0.3, 0.1
"""A controller overshoots by less than this share of a move, and by less than so much."""


@dataclass(frozen=True, slots=True)
class Stand:
    """One standstill: first and last sample (indices), their times, median of the readings."""

    first: int
    last: int
    start_s: float
    end_s: float
    level: float


def noise_of(y: F1) -> float:
    """Standard deviation of one sample from second differences: neither standing nor steady motion adds to it (robust)."""
    second = y[2:] - 2.0 * y[1:-1] + y[:-2]
    return float(np.median(np.abs(second)) * 1.4826 / np.sqrt(6.0))


def stands(t_s: F1, y: F1, *, smallest_move: float, least_s: float) -> tuple[Stand, ...]:
    """All standstills of a stream, in order.

    Two neighbouring samples are of one standstill if they differ by less than noise can.
    Single samples that stick out do not end a standstill; after one, the level is the same.

    Parameters
    ----------
    t_s, y : array, shape (n,)
        Sample times and readings.
    smallest_move : float
        Of the plan, in the unit of ``y``.
    least_s : float
        Shortest standstill that counts.
    """
    limit = max(CLEAR * np.sqrt(2.0) * noise_of(y), RESOLVED * smallest_move)
    still = np.abs(np.diff(y)) <= limit
    out: list[Stand] = []
    for first, last in _runs(still):
        found = _stand(t_s, y, first, last)
        if out and _goes_on(out[-1], found, limit):
            found = _stand(t_s, y, out.pop().first, last)
        out.append(found)
    return tuple(s for s in out if s.last - s.first + 1 >= LEAST_SAMPLES and s.end_s - s.start_s >= least_s)


def _goes_on(before: Stand, after: Stand, limit: float) -> bool:
    return after.first - before.last <= 3 and abs(after.level - before.level) <= limit


def _stand(t_s: F1, y: F1, first: int, last: int) -> Stand:
    return Stand(first, last, float(t_s[first]), float(t_s[last]), float(np.median(y[first : last + 1])))


def _runs(still: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> list[tuple[int, int]]:
    """First and last sample of each unbroken run of small differences."""
    edge = np.diff(np.concatenate([[0], still.astype(int), [0]]))
    return [(int(a), int(b)) for a, b in zip(np.flatnonzero(edge == 1), np.flatnonzero(edge == -1), strict=True)]


def sides(t_s: F1, y: F1, found: tuple[Stand, ...], smallest: float) -> F1:
    """From which side each standstill was approached: +1 from smaller readings, -1 from larger, 0 where nothing tells.

    The last sample before it that lies well off says so; what a controller overshoots by is less than that.
    """
    out, least = np.zeros(len(found)), CLEAR * noise_of(y)
    for s in range(1, len(found)):
        one, before = found[s], found[s - 1]
        far = max(least, min(OVERSHOOT * max(abs(one.level - before.level), smallest), OVERSHOOT_MM))
        away = y[before.first : one.first] - one.level
        off = np.flatnonzero(np.abs(away) > far)
        if off.size:
            out[s] = -np.sign(away[off[-1]])
    return out
