"""Resumes an interrupted path where it was, and proves that the set-up is unchanged. Pure.

While the ball-bar records, the controller's statuses show how far the axes came at constant feed (`PathProgress`). If the path is
interrupted and bar and cup stay in place, the machine need not begin again: it drives back along the path beyond the last valid point, by a
stretch and a lead, and comes forward again. On the lead every axis takes up its lost motion as before; on the stretch the bar must repeat
its readings (`StretchComparison`). The runs up to their stretches, and the last run, form one path. Readings just before the interruption
serve only for this comparison.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from abbe.drivers.api import BarSample, ControllerStatus
from abbe.drivers.flags import bar_is_valid, on_path
from abbe.models.arrays import F1
from abbe.service.errors import RunInterrupted, StretchDiffers
from abbe.service.runs.pieces import LEAST_READINGS, STRETCH_MM, STRETCH_S, ReadProgress, RunPiece, arc_of
from abbe.service.sequences.steps import Point, RecordPath

LEAD_S, LEAD_MM = 0.5, 5.0
"""Least time and length of the lead before readings count: the axes reach constant feed and take up their lost motion."""
SAME_MM = 0.0015
"""Allowed difference of the stretch's median: minutes of drift, but not a displaced cup."""
STEADY_MM = 0.1
"""Allowed change of the lag behind constant feed, either way."""
BEHIND_S, BEHIND_MM = 0.15, 0.5
"""Largest lag of a machine at constant feed behind its command, from acceleration and position control: seconds of feed plus a constant."""
AROUND_MM = 100.0


class PathProgress:
    """How far a path has come at constant feed, from the controller's statuses; an interrupted run stores `doc`."""

    def __init__(self, step: RecordPath) -> None:
        self._points, self._arc = np.asarray(step.points_mm, dtype=np.float64), arc_of(step.points_mm)
        self._feed_mm_s = step.feed_mm_min / 60.0
        self._lag_mm: float | None = None
        self._lost = False
        self.start_us: int | None = None
        self.good_us: int | None = None
        self.boot_id: int | None = None

    @property
    def good_mm(self) -> float:
        """Length driven at constant feed, mm."""
        if self.good_us is None or self.start_us is None:
            return 0.0
        return (self.good_us - self.start_us) * 1e-6 * self._feed_mm_s

    def add(self, status: ControllerStatus) -> None:
        """Add a status that was read while the path ran without trouble."""
        if self._lost or status.path_start_us <= 0:
            return
        gone_s = (status.ctrl_us - status.path_start_us) * 1e-6
        if gone_s < LEAD_S:
            return
        lag_mm = self._lag(gone_s * self._feed_mm_s, status.position_mm)
        if lag_mm is None:
            return
        self._lag_mm = lag_mm if self._lag_mm is None else self._lag_mm
        if abs(lag_mm - self._lag_mm) > STEADY_MM or abs(self._lag_mm) > BEHIND_S * self._feed_mm_s + BEHIND_MM:
            self._lost = True  # the feed changed, or the axes stand: from here on the position of a sample is unknown
            return
        self.start_us, self.good_us = status.path_start_us, status.ctrl_us

    def _lag(self, gone_mm: float, position_mm: Point) -> float | None:
        """Lag of the position behind constant feed, mm; None if the position is not on the path near there."""
        first, last = np.searchsorted(self._arc, (gone_mm - AROUND_MM, gone_mm + AROUND_MM))
        points, arc = self._points[max(first - 1, 0) : last + 1], self._arc[max(first - 1, 0) : last + 1]
        if len(points) < 2:
            return None
        begin, along, length = points[:-1], np.diff(points, axis=0), np.diff(arc)
        share = np.clip(((position_mm - begin) * along).sum(axis=1) / np.maximum(length**2, 1e-18), 0.0, 1.0)
        off = np.linalg.norm(begin + share[:, None] * along - position_mm, axis=1)
        at = arc[:-1] + share * length
        near = off <= off.min() + 1e-3
        return float(gone_mm - at[near][np.argmin(np.abs(at[near] - gone_mm))]) if off.min() < STEADY_MM else None

    def doc(self) -> dict[str, Any]:
        """Fields for the end document of an interrupted run; empty when the path cannot resume."""
        if self.good_us is None or self.boot_id is None:
            return {}
        return {"path_start_us": self.start_us, "good_us": self.good_us, "box_boot_id": self.boot_id}


@dataclass(frozen=True, slots=True)
class PathRemainder:
    """Rest of an interrupted path: valid ``pieces``, and ``offset_mm``, the length of the whole path at which the rest begins.

    ``arc_mm`` and ``deviation_mm``, shape (n,): earlier readings on the stretch, by length along the rest; ``boot_id``: of their box.
    """

    pieces: tuple[RunPiece, ...]
    offset_mm: float
    whole_mm: float
    feed_mm_s: float
    arc_mm: F1
    deviation_mm: F1
    boot_id: int

    def doc(self) -> dict[str, Any]:
        """As JSON object for ``path`` in the start document."""
        return {"offset_mm": self.offset_mm, "pieces": [{"run": p.run, "to_mm": p.to_mm} for p in self.pieces]}


def rest_of_path(step: RecordPath, so_far: ReadProgress) -> tuple[RecordPath, int, PathRemainder] | None:
    """Return the rest of a path, the number of its first point, and its `PathRemainder`.

    None: resuming saves nothing, or there are too few readings to compare with.
    """
    arc, feed_mm_s = arc_of(step.points_mm), step.feed_mm_min / 60.0
    last = len(arc) - 1 if step.measured is None else step.measured[1]
    good_mm = so_far.pieces[-1].to_mm
    counts = min(_before(arc, good_mm), last - 1)
    twice = _before(arc, arc[counts] - max(STRETCH_MM, STRETCH_S * feed_mm_s))
    begin = _before(arc, arc[max(twice, 0)] - max(LEAD_MM, LEAD_S * feed_mm_s))
    on = (so_far.arc_mm >= arc[max(twice, 0)]) & (so_far.arc_mm <= arc[counts])
    if begin <= 0 or twice <= _before(arc, so_far.counted_from_mm) or int(on.sum()) < 2 * LEAST_READINGS:
        return None
    ends = last if step.measured else len(arc) - 1
    rest = RecordPath(step.points_mm[begin:], step.feed_mm_min, step.rate_hz, step.direction, (twice - begin, ends - begin))
    pieces = (*so_far.pieces[:-1], RunPiece(so_far.pieces[-1].run, float(arc[twice])))
    offset = float(arc[begin])
    known = (so_far.arc_mm[on] - offset, so_far.deviation_mm[on])
    return rest, begin, PathRemainder(pieces, offset, float(arc[-1]), feed_mm_s, *known, so_far.boot_id)


def _before(arc: F1, at_mm: float) -> int:
    """The last point at or before a length; -1 if there is none."""
    return int(np.searchsorted(arc, at_mm + 1e-9, side="right")) - 1


class StretchComparison:
    """Compares the bar's readings on the stretch with its earlier readings there."""

    def __init__(self, remainder: PathRemainder, rate_hz: int) -> None:
        self._on, self._half_s = remainder, 0.5 / rate_hz
        self._first_us: int | None = None
        self._last: BarSample | None = None
        self._off: list[float] = []
        slope, _ = np.polyfit(remainder.arc_mm, remainder.deviation_mm, 1)
        # The start of each path is known to half a sample period.
        self._allowed_mm = SAME_MM + abs(float(slope)) * remainder.feed_mm_s / rate_hz
        self.off_mm: float | None = None
        """Difference of the stretch's readings, mm, once it is read."""

    def from_box(self, boot_id: int) -> None:
        """Raise RunInterrupted if the box was restarted: its earlier readings must not be joined to new ones."""
        if boot_id != self._on.boot_id:
            raise RunInterrupted("the ball-bar's box was restarted since the path was broken off", "the path begins again")

    def add(self, sample: BarSample) -> None:
        """Add the next sample. Raises StretchDiffers if the stretch reads otherwise, or could not be read."""
        before, self._last = self._last, sample
        if self.off_mm is not None or not on_path(sample.status):
            return
        if self._first_us is None:
            if before is None or (before.seq + 1) % 2**32 != sample.seq:
                raise StretchDiffers("the samples at which the path began were lost", "look at the ball-bar's cable; the path begins again")
            self._first_us = sample.device_us
        at_mm = ((sample.device_us - self._first_us) * 1e-6 + self._half_s) * self._on.feed_mm_s
        if at_mm > self._on.arc_mm[-1]:
            self.judge()
        elif at_mm >= self._on.arc_mm[0] and bar_is_valid(sample.status):
            self._off.append(sample.reading_nm * 1e-6 - float(np.interp(at_mm, self._on.arc_mm, self._on.deviation_mm)))

    def judge(self) -> None:
        """Compare the stretch; called when the stretch has passed, and when the path has ended.

        Raises
        ------
        StretchDiffers
            The stretch reads otherwise, or has too few readings.
        """
        if self.off_mm is not None:
            return
        if len(self._off) < LEAST_READINGS:
            raise StretchDiffers("the stretch that is read twice gave too few readings", "look at bar and box; the path begins again")
        off = np.array(self._off)
        noise_mm = 1.4826 * float(np.median(np.abs(off - np.median(off)))) / np.sqrt(off.size)
        self.off_mm = float(np.median(off))
        if abs(self.off_mm) > self._allowed_mm + 3.0 * noise_mm:
            raise StretchDiffers(
                f"the path's last stretch reads {1e3 * abs(self.off_mm):.1f} um otherwise than before the break "
                f"(allowed: {1e3 * self._allowed_mm:.1f})",
                "cup or bar was displaced, or the machine has drifted: the path begins again, or is mounted anew",
            )
