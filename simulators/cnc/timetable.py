"""An NC program that the operator has started, as a function of time: lines at their feeds, and rests."""

import numpy as np

from abbe.simulators.arrays import F


class Timetable:
    """What `Motion` is for one command, for a whole program: knots of program time and position, straight in between.

    ``set_factor`` (feed hold, override) changes how fast program time runs; rests run with it.
    """

    def __init__(self, start_mm: F, blocks: list[tuple[F, float]], start_s: float) -> None:
        """``blocks``: place (3,) and the seconds that it takes to get there; a rest is its own place again."""
        self._knots = np.concatenate([[0.0], np.cumsum([seconds for _, seconds in blocks])])
        self._places = np.stack([start_mm, *(place for place, _ in blocks)])
        self._ref_s, self._ref, self._factor = start_s, 0.0, 1.0

    @property
    def total_mm(self) -> float:
        """Way of the whole program."""
        return float(np.linalg.norm(np.diff(self._places, axis=0), axis=1).sum())

    @property
    def target_mm(self) -> F:
        """Where it ends, (3,) mm."""
        last: F = self._places[-1]
        return last

    @property
    def vertex_count(self) -> int:
        """Blocks."""
        return len(self._places) - 1

    def set_factor(self, factor: float, now_s: float) -> None:
        """Let program time run ``factor`` times as fast from now on."""
        self._ref = self._program_s(now_s)
        self._ref_s, self._factor = now_s, factor

    def extend(self, vertices_mm: F) -> None:
        """A program cannot be extended."""
        raise ValueError("an NC program runs")

    def position(self, times_s: F) -> F:
        """Commanded point at n instants: (n, 3) mm."""
        program = np.clip(self._ref + self._factor * (times_s - self._ref_s), 0.0, self._knots[-1])
        return np.stack([np.interp(program, self._knots, self._places[:, a]) for a in range(3)], axis=1)

    def end_s(self) -> float:
        """Instant at which it ends at the present factor; infinity on hold."""
        rest = float(self._knots[-1]) - self._ref
        if rest <= 0.0:
            return self._ref_s
        return self._ref_s + rest / self._factor if self._factor > 0.0 else float("inf")

    def vertex_times(self, from_s: float, to_s: float) -> F:
        """Instants in (from_s, to_s] at which a block ends: where an axis can turn round."""
        if self._factor <= 0.0:
            return np.empty(0)
        times: F = self._ref_s + (self._knots - self._ref) / self._factor
        return times[(times > from_s) & (times <= to_s)]

    def vertices_reached(self, now_s: float) -> int:
        """Blocks done."""
        return int(np.searchsorted(self._knots[1:], self._program_s(now_s) + 1e-12, side="right"))

    def _program_s(self, now_s: float) -> float:
        return float(np.clip(self._ref + self._factor * (now_s - self._ref_s), 0.0, self._knots[-1]))
