"""What a running path reads, for live views: a bounded copy beside the way to the disk, which never waits and may lose.

The driver's thread puts batches in (`LiveFeed.take`), the event loop takes stretches out. What is not taken out in time is dropped here and
nowhere else: the recorder has been given every sample before.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from abbe.drivers.api import BarBatch, Point
from abbe.drivers.flags import bar_is_valid, on_path
from abbe.service.domain.bounds import WORD
from abbe.service.domain.recorded_path import RecordedPath
from abbe.service.runs.helix_axis import about_axis, helix_axis

F1 = NDArray[np.float64]
Values = NDArray[np.float32]

MOST_BATCHES = 2000
"""So many batches wait at most: seconds of a page that is being started again."""
LONGEST = 4096
"""So many deviations make a stretch at most: a message of the channel is bounded, and a longer one would end the page's process."""
ANGLES = 512
"""Places of a path whose angle is sent; in between the browser interpolates."""
UM_PER_NM = 1e-3


@dataclass(frozen=True, slots=True)
class Stretch:
    """Deviations that follow each other, µm; not a number where the box says that it did not read.

    ``first``: number of the first one, counted from the sample with which the path began; ``host_s``: when the last one arrived here.
    """

    path: int
    first: int
    host_s: float
    values_um: Values


class LiveFeed:
    """The path that is being recorded now, and what it has read lately. Make it before the event loop runs or inside of it."""

    def __init__(self) -> None:
        self.path: RecordedPath | None = None
        self.active = asyncio.Event()
        """Set while a path is recorded."""
        self._number = 0
        self._first_seq: int | None = None
        self._batches: deque[BarBatch] = deque(maxlen=MOST_BATCHES)

    def begin(self, run: str, test: str, setup: Mapping[str, Any], path: tuple[Sequence[Point], float, int]) -> None:
        """Hear that a path is going to be recorded: its points in mm, feed in mm/min and rate in Hz."""
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
            radius_mm=float(setup["radius_mm"]),
            feed_mm_min=feed_mm_min,
            rate_hz=rate_hz,
            duration_s=duration_s,
            angle_deg=angle_deg,
        )
        self.active.set()

    def end(self) -> None:
        """Hear that it is over, however it ended."""
        self.path = None
        self.active.clear()

    def take(self, batch: BarBatch) -> None:
        """Take a batch; in the driver's thread. Never waits, never raises."""
        if self._first_seq is None:
            self._first_seq = next((sample.seq for sample in batch.samples if on_path(sample.status)), None)
        if self._first_seq is not None:
            self._batches.append(batch)

    def stretches(self) -> list[Stretch]:
        """What has come since the last call, as few stretches as gaps and `LONGEST` allow; in the event loop."""
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


def angles_along(points_mm: Sequence[Point], setup: Mapping[str, Any]) -> tuple[F1, float]:
    """Angle about a ball-bar test's axis at `ANGLES` even parts of its path, degrees, not wrapped; and the path's length in mm.

    Angles count from the first axis of the plane to its second, as in a recipe. None where neither set-up nor path tells the axis: there
    is no round picture of it.
    """
    points = np.asarray(points_mm, dtype=np.float64) - np.asarray(setup["centre_mm"], dtype=np.float64)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    if setup.get("plane"):
        across, up = (points[:, "XYZ".index(letter)] for letter in str(setup["plane"]))
        about = np.arctan2(up, across)
    elif (axis := helix_axis(setup, points)) is not None:
        about = about_axis(points, axis)
    else:
        return np.zeros(0), float(arc[-1])
    angle = np.rad2deg(np.unwrap(about))
    return np.interp(np.linspace(0.0, arc[-1], ANGLES), arc, angle), float(arc[-1])
