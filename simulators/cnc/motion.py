"""The commanded point on its way: straight segments run at constant feed, as a function of time."""

import numpy as np

from abbe.simulators.arrays import F


class Motion:
    """One polyline under way: the commanded point runs from the first to the last vertex at constant speed.

    Start and stop are instantaneous. Between two changes of speed the travelled length is linear in time, so any number of
    instants can be evaluated at once; a change of speed (hold, override) only moves the reference instant.
    """

    def __init__(self, vertices_mm: F, speed_mm_s: float, start_s: float) -> None:
        self._vertices = vertices_mm
        self._length = _lengths(vertices_mm)
        self._ref_s = start_s
        self._ref_mm = 0.0
        self._speed = speed_mm_s
        self._factor = 1.0

    @property
    def total_mm(self) -> float:
        """Length of the whole polyline."""
        return float(self._length[-1])

    @property
    def target_mm(self) -> F:
        """Last vertex, (3,) mm."""
        last: F = self._vertices[-1]
        return last

    @property
    def vertex_count(self) -> int:
        """Vertices without the starting point."""
        return len(self._vertices) - 1

    def set_factor(self, factor: float, now_s: float) -> None:
        """Change the speed to ``factor`` times the feed from ``now_s`` on (0 = feed hold)."""
        self._ref_mm = float(self.travelled(np.array([now_s]))[0])
        self._ref_s = now_s
        self._factor = factor

    def extend(self, vertices_mm: F) -> None:
        """Append vertices (n, 3) to the running polyline."""
        added = _lengths(np.vstack([self._vertices[-1:], vertices_mm]))[1:]
        self._length = np.concatenate([self._length, self.total_mm + added])
        self._vertices = np.vstack([self._vertices, vertices_mm])

    def travelled(self, times_s: F) -> F:
        """Length run at n instants, mm."""
        run = self._ref_mm + self._speed * self._factor * (times_s - self._ref_s)
        clipped: F = np.clip(run, 0.0, self.total_mm)
        return clipped

    def position(self, times_s: F) -> F:
        """Commanded point at n instants: (n, 3) mm."""
        run = self.travelled(times_s)
        return np.stack([np.interp(run, self._length, self._vertices[:, a]) for a in range(3)], axis=1)

    def end_s(self) -> float:
        """Instant of arrival at the present speed; infinity on hold."""
        rest = self.total_mm - self._ref_mm
        speed = self._speed * self._factor
        if rest <= 0.0:
            return self._ref_s
        return self._ref_s + rest / speed if speed > 0.0 else float("inf")

    def vertex_times(self, from_s: float, to_s: float) -> F:
        """Instants in (from_s, to_s] at which a vertex is passed: where an axis can turn round."""
        speed = self._speed * self._factor
        if speed <= 0.0:
            return np.empty(0)
        begin, end = self.travelled(np.array([from_s, to_s]))
        first, last = np.searchsorted(self._length, [begin, end], side="right")
        times: F = self._ref_s + (self._length[first:last] - self._ref_mm) / speed
        return times

    def vertices_reached(self, now_s: float) -> int:
        """Vertices reached, the starting point not counted."""
        run = float(self.travelled(np.array([now_s]))[0])
        # a thousandth of a nanometre forgives the rounding of an arrival computed from its own instant
        return int(np.searchsorted(self._length[1:], run + 1e-9, side="right"))


def _lengths(vertices_mm: F) -> F:
    """Length from the first vertex to each: (n,) mm."""
    steps = np.linalg.norm(np.diff(vertices_mm, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])
