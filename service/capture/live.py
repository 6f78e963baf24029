"""Readings of a running path for live views: a bounded copy that never delays the recording and may drop data.

The driver's thread puts batches in (`LiveFeed.take`), and the event loop takes stretches out. Batches that wait too long are dropped from
the live view only: the recorder already has every sample.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from abbe.drivers.api import BarBatch, Point, bar_is_valid, on_path
from abbe.service.domain.document import WORD
from abbe.service.domain.progress import MachineReading, RecordedPath
from abbe.service.domain.run import BarSetup
from abbe.service.runs.coverage import about_axis, helix_axis

F1 = NDArray[np.float64]
Values = NDArray[np.float32]

MOST_BATCHES = 2000
"""Maximum number of waiting batches: enough for the seconds in which the web process restarts."""
LONGEST = 4096
"""Maximum number of deviations per stretch: channel messages are bounded, and a longer one would end the web process."""
ANGLES = 512
"""Number of path positions whose angle is sent; the browser interpolates between them."""
UM_PER_NM = 1e-3


@dataclass(frozen=True, slots=True)
class Stretch:
    """Consecutive deviations, µm; NaN for invalid readings.

    ``first``: number of the first one, counted from the first sample of the path; ``host_s``: arrival time of the last one.
    """

    path: int
    first: int
    host_s: float
    values_um: Values


class LiveFeed:
    """The current path and its latest readings. Create it before the event loop runs, or in it."""

    def __init__(self) -> None:
        self.path: RecordedPath | None = None
        self.active = asyncio.Event()
        """Set while there is something to show: a path, or a machine that is being measured."""
        self.machine: Callable[[], MachineReading | None] | None = None
        """Tells the present state of the machine during a measurement."""
        self._number = 0
        self._first_seq: int | None = None
        self._batches: deque[BarBatch] = deque(maxlen=MOST_BATCHES)

    def begin(self, run: str, test: str, setup: BarSetup, path: tuple[Sequence[Point], float, int]) -> None:
        """Begin a path, given by its points in mm, feed in mm/min and rate in Hz."""
        points_mm, feed_mm_min, rate_hz = path
        self._number += 1
        self._first_seq = None
        self._batches.clear()
        angles, length_mm = angles_along(points_mm, setup)
        angle_deg = tuple(round(float(a), 2) for a in angles)
        duration_s = length_mm / feed_mm_min * 60.0
        self.path = RecordedPath(
            number=self._number,
            run=run[:WORD],
            test=test[:WORD],
            radius_mm=setup.radius_mm,
            feed_mm_min=feed_mm_min,
            rate_hz=rate_hz,
            duration_s=duration_s,
            angle_deg=angle_deg,
        )
        self._show()

    def end(self) -> None:
        """End the path."""
        self.path = None
        self._show()

    @contextmanager
    def showing(self, machine: Callable[[], MachineReading | None]) -> Iterator[None]:
        """Show the state of the machine during this block."""
        self.machine = machine
        self._show()
        try:
            yield
        finally:
            self.machine = None
            self._show()

    def _show(self) -> None:
        if self.path is None and self.machine is None:
            self.active.clear()
        else:
            self.active.set()

    def take(self, batch: BarBatch) -> None:
        """Receive a batch in the driver's thread. Never waits, never raises."""
        if self._first_seq is None:
            self._first_seq = next((sample.seq for sample in batch.samples if on_path(sample.status)), None)
        if self._first_seq is not None:
            self._batches.append(batch)

    def stretches(self) -> list[Stretch]:
        """Return the readings since the last call, in as few stretches as gaps and `LONGEST` allow; call it in the event loop."""
        path, first_seq = self.path, self._first_seq
        if path is None or first_seq is None:
            return []
        numbers: list[int] = []
        values: list[float] = []
        host_s = 0.0
        while self._batches:
            batch = self._batches.popleft()
            host_s = batch.host_s
            for sample in batch.samples:
                if on_path(sample.status):
                    numbers.append((sample.seq - first_seq) % 2**32)
                    values.append(sample.reading_nm * UM_PER_NM if bar_is_valid(sample.status) else float("nan"))
        return _cut(path.number, numbers, np.array(values, dtype=np.float32), host_s)


def _cut(path: int, numbers: list[int], values: Values, host_s: float) -> list[Stretch]:
    if not numbers:
        return []
    gaps = [0, *(int(cut) for cut in np.flatnonzero(np.diff(numbers) != 1) + 1), len(numbers)]
    firsts = [at for start, stop in pairwise(gaps) for at in range(start, stop, LONGEST)]
    return [Stretch(path, numbers[at], host_s, part) for at, part in zip(firsts, np.split(values, firsts[1:]), strict=True)]


def angles_along(points_mm: Sequence[Point], setup: BarSetup) -> tuple[F1, float]:
    """Return the angle about a ball-bar test's axis at `ANGLES` equally spaced path positions, degrees, unwrapped; and the path length, mm.

    Angles count from the first axis of the plane to its second, as in a recipe. The angles are empty if neither set-up nor path defines the
    axis: such a path has no polar plot.
    """
    points = np.asarray(points_mm, dtype=np.float64) - setup.centre_mm
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    if setup.plane:
        across, up = (points[:, "XYZ".index(letter)] for letter in setup.plane)
        about = np.arctan2(up, across)
    elif (axis := helix_axis(setup.axis, points)) is not None:
        about = about_axis(points, axis)
    else:
        return np.zeros(0), float(arc[-1])
    angle = np.rad2deg(np.unwrap(about))
    return np.interp(np.linspace(0.0, arc[-1], ANGLES), arc, angle), float(arc[-1])
