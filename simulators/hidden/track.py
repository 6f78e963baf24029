"""A run as the machine drives it: commanded positions at every instant, directions of the last motion, times of reversal."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from abbe.simulators.arrays import F

Course = Callable[[F], F]
"""Maps campaign times (n,) s to commanded positions (n, 3) mm, also slightly before the start and after the end of a run."""
DENSE_MM = 0.12
"""Largest travel between two instants at which the motion is followed."""
RUN_IN_MM = 3.0
"""Length of the course before the first sample of a run: a ball-bar run has an angular overshoot."""
NEVER_MM = 1e9
STILL_MM = 1e-6


@dataclass(frozen=True, slots=True)
class Track:
    """One run, or one instant at standstill.

    ``kind``: "bar", "laser" or "live" (the simulated devices). ``setup``: its name, ``set_s``: its time. ``q_mm`` (n, 3), ``t_s`` (n,):
    commanded positions and times of the readings; ``v_mm_s``, ``a_mm_s2`` (n, 3): their derivatives. ``sign`` (n, 3): direction of each
    axis' last motion, 0 if unknown; ``since_mm`` (n, 3): travel since the last reversal (`NEVER_MM` before the first); ``travelled_mm``
    (n, 3): travel in the run. ``look`` (n, 3): unit vector of the measuring direction; ``reach_mm`` (n,): nominal laser path since the
    first record, zeros for a bar. ``start_s``: when the run began. ``low_mm``, ``high_mm`` (3,): strokes. ``vertical``: index of that axis.
    ``number``: the run's index, -1 while a cup is set. ``radius_mm``: of the bar. ``course``: commanded position by time, for a moving run.
    """

    kind: str
    setup: str
    q_mm: F
    t_s: F
    v_mm_s: F
    a_mm_s2: F
    sign: F
    since_mm: F
    travelled_mm: F
    look: F
    reach_mm: F
    start_s: float
    set_s: float
    low_mm: F
    high_mm: F
    vertical: int
    feed_mm_min: float
    number: int
    radius_mm: float = 0.0
    course: Course | None = None

    @property
    def moving(self) -> bool:
        """Whether the machine moves during readings: true for ball-bar runs and simulated devices, false for laser runs, which dwell."""
        return self.course is not None or self.kind == "live"

    @property
    def n(self) -> int:
        """Number of readings."""
        return len(self.t_s)

    def zeros(self) -> F:
        """Return one zero per reading."""
        return np.zeros(self.n)


@dataclass(frozen=True, slots=True)
class History:
    """State that the axes have at n times because of their earlier motion; arrays as in `Track`."""

    sign: F
    since_mm: F
    travelled_mm: F


def history(dense_mm: F, at: np.ndarray, rest: F) -> History:
    """Follow a dense course (m, 3) mm and return the state at its indices ``at`` (n,).

    Before its first motion an axis has the direction of that motion; an axis that never moves has the direction ``rest`` (3,).
    """
    step = np.diff(dense_mm, axis=0)
    sign, since, travelled = (np.zeros((len(at), 3)) for _ in range(3))
    for a in range(3):
        s, walked, last = _axis(step[:, a], float(rest[a]))
        sign[:, a], travelled[:, a] = s[at], walked[at]
        since[:, a] = (walked - last)[at]
    return History(sign, since, travelled)


def _axis(step_mm: F, rest: float) -> tuple[F, F, F]:
    """Return three arrays (m,), for the start and after each of m - 1 steps: direction, travel, and travel at the last reversal."""
    way = np.where(np.abs(step_mm) > 1e-9, np.sign(step_mm), 0.0)
    moved = np.flatnonzero(way)
    walked = np.concatenate([[0.0], np.cumsum(np.abs(step_mm))])
    if not moved.size:
        return np.full(len(walked), rest), walked, np.full(len(walked), -NEVER_MM)
    newest = np.maximum.accumulate(np.where(way != 0, np.arange(len(way)), -1))
    direction = np.concatenate([[way[moved[0]]], way[np.where(newest < 0, moved[0], newest)]])
    turned = np.flatnonzero(np.diff(direction)) + 1
    if not turned.size:
        return direction, walked, np.full(len(walked), -NEVER_MM)
    which = np.searchsorted(turned, np.arange(len(walked)), side="right") - 1
    return direction, walked, np.where(which >= 0, walked[turned[np.maximum(which, 0)] - 1], -NEVER_MM)


def follow(drive_mm: F, half_mm: F) -> F:
    """Return the carriage positions (m,) mm of one axis with play, from drive positions (m,) and half widths (m,) of the play, mm.

    The first motion pushes the carriage from the start. Between two reversals of the drive the carriage rests or is pushed along: in a
    motion upwards it is at the larger of its last position and drive - half, downwards at the smaller of last position and drive + half.
    """
    step = np.diff(drive_mm)
    moved = np.flatnonzero(np.abs(step) > 1e-9)
    if not moved.size:
        return drive_mm.copy()
    way = np.sign(step)
    ends = np.concatenate([[0], moved[1:][way[moved[1:]] != way[moved[:-1]]], [len(step)]])
    out = np.empty_like(drive_mm)
    up = way[moved[0]] > 0
    out[0] = drive_mm[0] - half_mm[0] if up else drive_mm[0] + half_mm[0]
    for first, last in itertools.pairwise(ends.tolist()):
        piece = slice(first + 1, last + 1)
        pushed = drive_mm[piece] - half_mm[piece] if up else drive_mm[piece] + half_mm[piece]
        # a negative width (a control that corrects too much) has no free travel: the carriage jumps
        free = half_mm[piece] >= 0
        kept = np.maximum(pushed, out[first]) if up else np.minimum(pushed, out[first])
        out[piece] = np.where(free, kept, pushed)
        up = not up
    return out


def dense_times(track: Track) -> tuple[F, np.ndarray]:
    """Return the instants at which a moving run is followed, from `RUN_IN_MM` before its start, and the index of each sample in them."""
    feed = track.feed_mm_min / 60.0
    step_s = float(np.median(np.diff(track.t_s)))
    parts = max(1, int(np.ceil(step_s * feed / DENSE_MM)))
    fine = np.interp(np.arange(parts * (track.n - 1) + 1) / parts, np.arange(track.n), track.t_s)
    ahead = track.t_s[0] - np.linspace(RUN_IN_MM / feed, 0.0, int(RUN_IN_MM / DENSE_MM), endpoint=False)
    return np.concatenate([ahead, fine]), len(ahead) + parts * np.arange(track.n)


def carriage_mm(track: Track, axis: int, half: Callable[[F], F]) -> F:
    """Return the displacement of an axis by lost motion, (n,) mm; ``half``: half width of the play as a function of the position."""
    if track.course is None:
        if track.kind == "bar":
            return np.zeros(track.n)  # one instant: the approach is unknown
        moved = track.q_mm[:, axis]
        lead = moved[0] - RUN_IN_MM * track.sign[0, axis]
        path = np.concatenate([[lead], moved])
        return np.asarray((follow(path, half(path)) - path)[1:])
    if float(np.ptp(track.q_mm[:, axis])) < STILL_MM:
        return np.asarray(-track.sign[:, axis] * half(track.q_mm[:, axis]))
    times, at = dense_times(track)
    path = track.course(times)[:, axis]
    return np.asarray((follow(path, half(path)) - path)[at])
