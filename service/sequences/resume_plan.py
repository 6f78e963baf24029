"""Point at which an interrupted test resumes, and the way there. Only computes; no device is used.

A bar must not move through its sphere, nor a mirror out of its beam: the machine returns the way the test came, to the last checkpoint. A
ball-bar path resumes where it was interrupted, or begins again. A laser run resumes after its last complete point, once that point has
been read again with the same result. An artefact resumes at the next feature, once its first feature has been touched again.

While the ball-bar records, the controller's statuses show how far the axes came at constant feed (`PathProgress`). If the path is
interrupted and bar and cup stay in place, the machine need not begin again: it drives back along the path beyond the last valid point, by a
stretch and a lead, and comes forward again. On the lead every axis takes up its lost motion as before; on the stretch the bar must repeat
its readings (`StretchComparison`). The path is joined from the interrupted runs, each up to the start of its stretch, and the last run.
Readings just before the interruption serve only for this comparison.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from abbe.drivers.api import BarSample, ControllerStatus, bar_is_valid, on_path
from abbe.models.arrays import F1
from abbe.service.domain.machine import Point
from abbe.service.domain.measured import RunPiece, arc_of
from abbe.service.errors import RunInterrupted, SetupDisturbed, StretchDiffers
from abbe.service.runs.pieces import LEAST_READINGS, STRETCH_MM, STRETCH_S, PathReadings, ReadProgress
from abbe.service.sequences.recipes.approach import cup_of, over_pole
from abbe.service.sequences.steps import (
    ChangeBar,
    FollowPath,
    MountArtefact,
    MountBar,
    MountLaser,
    MoveTo,
    ReadBar,
    ReadLaser,
    RecordPath,
    Step,
    TakeBarOut,
    TestPlan,
    TouchFeature,
    Unmount,
    references_of,
)

LEAD_S, LEAD_MM = 0.5, 5.0
"""Minimum time and length of the lead before readings are used: the axes reach constant feed and take up their lost motion."""
SAME_MM = 0.0015
"""Allowed median change of the readings on the stretch: minutes of drift, but not a displaced cup."""
STEADY_MM = 0.1
"""Allowed change of the lag behind constant feed, either way."""
BEHIND_S, BEHIND_MM = 0.15, 0.5
"""Largest lag behind the command at constant feed: feed times `BEHIND_S`, plus `BEHIND_MM`. Acceleration and position control cause it."""
AROUND_MM = 100.0


class PathProgress:
    """Progress of a path at constant feed, from the controller's statuses; an interrupted run stores `doc`."""

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
        """Return how far the position lags behind constant feed along the path, mm; None if it is off the path or beyond `AROUND_MM`."""
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
        """Return fields for the end document of an interrupted run; empty when the path cannot resume."""
        if self.good_us is None or self.boot_id is None:
            return {}
        return {"path_start_us": self.start_us, "good_us": self.good_us, "box_boot_id": self.boot_id}


@dataclass(frozen=True, slots=True, kw_only=True)
class PathRemainder(PathReadings):
    """Rest of an interrupted path, and the earlier readings on the stretch that is measured again.

    ``offset_mm``: where the rest begins on the whole path, whose length is ``whole_mm``; ``arc_mm`` counts from there.
    """

    offset_mm: float
    whole_mm: float
    feed_mm_s: float

    def doc(self) -> dict[str, Any]:
        """Return what a resumed run adds to ``path`` of its start document: where the rest begins, and the runs of the earlier pieces."""
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
    return (
        rest,
        begin,
        PathRemainder(
            pieces=pieces,
            offset_mm=offset,
            whole_mm=float(arc[-1]),
            feed_mm_s=feed_mm_s,
            arc_mm=so_far.arc_mm[on] - offset,
            deviation_mm=so_far.deviation_mm[on],
            boot_id=so_far.boot_id,
        ),
    )


def _before(arc: F1, at_mm: float) -> int:
    """Return the number of the last point at or before this length of the path; -1 if there is none."""
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
        """Median of new minus earlier readings on the stretch, mm; None until the stretch is read."""

    def from_box(self, boot_id: int) -> None:
        """Raise RunInterrupted if the box was restarted: its earlier readings must not be joined to new ones."""
        if boot_id != self._on.boot_id:
            raise RunInterrupted(
                "the ball-bar's box was restarted since the path was interrupted", "Abbe measures the path again from its start"
            )

    def add(self, sample: BarSample) -> None:
        """Add the next sample. Raises StretchDiffers as `judge` does, or if the first samples were lost."""
        before, self._last = self._last, sample
        if self.off_mm is not None or not on_path(sample.status):
            return
        if self._first_us is None:
            if before is None or (before.seq + 1) % 2**32 != sample.seq:
                raise StretchDiffers(
                    "the first samples of the path were lost", "check the ball-bar's cable; Abbe measures the path again from its start"
                )
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
            The bar does not repeat its earlier readings on the stretch, or gave too few valid ones.
        """
        if self.off_mm is not None:
            return
        if len(self._off) < LEAST_READINGS:
            raise StretchDiffers(
                "too few valid readings when the path's last stretch was measured again",
                "check the ball-bar and its box; Abbe measures the path again from its start",
            )
        off = np.array(self._off)
        noise_mm = 1.4826 * float(np.median(np.abs(off - np.median(off)))) / np.sqrt(off.size)
        self.off_mm = float(np.median(off))
        if abs(self.off_mm) > self._allowed_mm + 3.0 * noise_mm:
            raise StretchDiffers(
                f"the path's last stretch reads {1e3 * abs(self.off_mm):.1f} um off its value before the interruption "
                f"(allowed: {1e3 * self._allowed_mm:.1f} um)",
                "cup or bar was displaced, or the machine has drifted; Abbe measures the path again from its start, "
                "or asks a person to mount the bar again",
            )


BY_HAND = MountBar | TakeBarOut | ChangeBar | MountLaser | MountArtefact | Unmount
STANDS = MountBar | TakeBarOut | ChangeBar | MountLaser
"""Steps after which the machine holds a bar, a cup or a mirror."""
OFF_PATH_MM = 0.05
"""Largest distance of the machine from the way it came; farther off, a program or person has moved it, and the set-up is not reliable."""
SAME_WAY_MM = 0.005
"""Tolerance for two passages of one place: chords deviate from the circle, and positions are rounded."""
KEEP_FROM = 2
"""A laser run with fewer complete points begins again: a repeated reading has nothing to be compared with."""
REFERENCE_MM = 0.003
"""Allowed difference of the repeated reading: minutes of drift and noise, but not a displaced mirror."""


@dataclass(frozen=True, slots=True)
class ResumeTrail:
    """Way of resuming: along ``trail`` (oldest point first) back to number ``to``, then forward to number ``upto``.

    With ``carried`` records the last one is read again at ``upto``. On the way forward every axis moves as before, so that its lost motion
    is the same. ``latest``: where the trail passes a place twice, the machine stands on the later passage. Empty trail: nothing is mounted.
    Trail of one point: the machine must stand there, and nothing moves. ``again``: references of an artefact's pose, which are touched
    again and must be as the first of the ``carried`` records found them.
    """

    trail: tuple[Point, ...] = ()
    to: int = 0
    upto: int = 0
    feed_mm_min: float = 1000.0
    latest: bool = False
    carried: tuple[dict[str, Any], ...] = ()
    again: tuple[TouchFeature, ...] = ()

    @property
    def n_features(self) -> int:
        """Number of carried features; a qualification sphere does not count."""
        return sum(one.get("u_sphere_mm") is None for one in self.carried)


@dataclass(frozen=True, slots=True)
class Attempt:
    """A part of a test to run.

    ``test``: label in the plan; ``offset``: number of the part's first step in it; ``mounting``: number of the set-up's mounting, from 1;
    ``run_id``: the run in the store.
    """

    test: str = ""
    setup: str = ""
    offset: int = 0
    mounting: int = 1
    resume_trail: ResumeTrail = field(default_factory=ResumeTrail)
    run_id: int = 0
    remainder: PathRemainder | None = None


Rest = tuple[TestPlan, int, ResumeTrail, PathRemainder | None]


def rest_of(
    test: TestPlan, hand: int | None, records: tuple[dict[str, Any], ...], before: Point | None, so_far: ReadProgress | None = None
) -> Rest:
    """Return the rest of a test, the number of its first step, the way back to it, and the rest of an interrupted path.

    Parameters
    ----------
    hand : int, optional
        Number of the last manual step that was done; None: none was.
    records : tuple of dict
        Laser records of complete points since this mounting's zero, oldest first; none for a ball-bar.
    before : tuple of float, optional
        End position of the previous test, if both share the set-up.
    so_far : ReadProgress, optional
        How far the path was read in this mounting.
    """
    first = 0 if hand is None else hand + 1
    start = before if hand is None else _final_position(test.steps[:first])
    if hand is not None and isinstance(test.steps[hand], TakeBarOut) and start is None:
        start = before
    steps = test.steps[first:]
    if records and any(isinstance(s, TouchFeature) for s in steps):
        return _after_feature(test, records)
    if len(records) >= KEEP_FROM and not any(isinstance(s, RecordPath | ReadBar) for s in steps):
        return _after_point(test, first, records)
    stands = start is not None and (hand is None or isinstance(test.steps[hand], STANDS))
    if not stands:
        return replace(test, steps=steps), first, ResumeTrail(), None
    if so_far is not None and (found := _along_path(test, first, start, so_far)) is not None:
        return found
    return replace(test, steps=steps), first, _to_beginning(_trail(start, _by_itself(steps)), steps), None


def _along_path(test: TestPlan, first: int, start: Point | None, so_far: ReadProgress) -> Rest | None:
    """Return the rest of a test that resumes in the middle of its path; None if the test cannot resume there."""
    steps = _by_itself(test.steps[first:])
    k = next((k for k, step in enumerate(steps) if isinstance(step, RecordPath)), None)
    path = None if k is None else steps[k]
    if k is None or not isinstance(path, RecordPath) or (found := rest_of_path(path, so_far)) is None:
        return None
    rest, begin, remainder = found
    trail = _trail(start, steps)
    to = len(_trail(start, (*steps[:k], replace(path, points_mm=path.points_mm[: begin + 1], measured=None)))) - 1
    return replace(test, steps=(rest, *test.steps[first + k + 1 :])), first + k, ResumeTrail(trail, to, to, _feed(steps)), remainder


def _to_beginning(trail: tuple[Point, ...], steps: tuple[Step, ...]) -> ResumeTrail:
    """Return the way along the trail to the start of the first remaining step or, if that step is a straight move, to its end."""
    to = 0 if isinstance(steps[0], FollowPath | RecordPath) else min(1, len(trail) - 1)
    return ResumeTrail(trail, to, to, _feed(steps))


def _by_itself(steps: tuple[Step, ...]) -> tuple[Step, ...]:
    """Return the steps before the first manual one: the way back does not lead past a change of the set-up."""
    cut = next((k for k, step in enumerate(steps) if isinstance(step, BY_HAND)), len(steps))
    return steps[:cut]


def _after_point(test: TestPlan, first: int, records: tuple[dict[str, Any], ...]) -> Rest:
    reads = [k for k, step in enumerate(test.steps) if k >= first and isinstance(step, ReadLaser)]
    last = reads[min(len(records), len(reads)) - 1]
    come = _trail(None, test.steps[: last + 1])
    ahead = _trail(come[-1], test.steps[last + 1 :])[1:2]
    upto = len(come) - 1
    feed = min(s.feed_mm_min for s in test.steps if isinstance(s, MoveTo))
    resume_trail = ResumeTrail(come + ahead, _all_axes_from(come), upto, feed, True, records[: len(reads)])
    return replace(test, steps=test.steps[last + 1 :]), last + 1, resume_trail, None


def _after_feature(test: TestPlan, records: tuple[dict[str, Any], ...]) -> Rest:
    """Resume an artefact at the next feature, after its references were touched again. A touch ends above its feature: no way back."""
    touches = [(k, s) for k, s in enumerate(test.steps) if isinstance(s, TouchFeature)]
    done = min(len(records), len(touches) - 1)  # the last one is a reference
    first, again = touches[done][0], references_of(s for _, s in touches[:done])
    return replace(test, steps=test.steps[first:]), first, ResumeTrail(carried=records[:done], again=again), None


def _all_axes_from(trail: tuple[Point, ...]) -> int:
    """Return the number of the latest point after which every axis that moves on the trail moves at least once more."""
    moved = np.abs(np.diff(np.array(trail), axis=0)) > 0.0
    return min((int(np.flatnonzero(moved[:, a])[-1]) for a in range(3) if moved[:, a].any()), default=len(trail) - 1)


def way_back(resume_trail: ResumeTrail, position_mm: Point) -> tuple[Point, ...]:
    """Return the positions to pass through on the way back. Raises SetupDisturbed if the machine stands off the way that it came."""
    if not resume_trail.trail:
        return ()
    trail, here = np.array(resume_trail.trail), np.array(position_mm)
    segment, off_mm = _nearest(trail, here, resume_trail.to, latest=resume_trail.latest)
    if off_mm > OFF_PATH_MM:
        raise SetupDisturbed(
            f"the machine stands {off_mm:.3f} mm off the path of the test: somebody moved it during the break",
            "mount the set-up again when Abbe asks for it",
        )
    if len(trail) == 1:
        return ()
    way, to = resume_trail.trail, resume_trail.to
    points = way[to : segment + 1][::-1] or way[segment + 1 : to + 1]  # the machine may also stand before ``to``
    return tuple(p for k, p in enumerate(points) if k or np.abs(np.array(p) - here).max() > 1e-5)


def remounted(test: TestPlan, first: TestPlan, number: int) -> TestPlan:
    """Return a test that begins by mounting its set-up anew, as mounting ``number``; ``first``: the test that mounted the set-up first."""
    named = anew(test, number)
    if test.mounts:
        return replace(named, steps=(Unmount(), *test.steps))
    k = next((k for k, step in enumerate(first.steps) if isinstance(step, MountBar | MountLaser)), None)
    if k is None:
        raise SetupDisturbed(
            f"another campaign mounted the set-up of test {test.label}, and this campaign cannot mount it again",
            "remove the instrument and start a new campaign",
        )
    opening: tuple[Step, ...] = (Unmount(), *(s for s in first.steps[: k + 1] if not isinstance(s, Unmount)))
    if not any(isinstance(step, MountBar) for step in opening):
        return replace(named, steps=(*opening, *test.steps))
    return replace(named, steps=(*opening[:-1], MountBar(test.bar.radius_mm), *_from_centre(test)))


def _from_centre(test: TestPlan) -> tuple[Step, ...]:
    """Return the steps of a test whose bar is mounted anew at the centre: over the pole, not from the end of the previous test."""
    first = next(k for k, step in enumerate(test.steps) if isinstance(step, RecordPath | ReadBar))
    near = [s for s in test.steps[:first] if isinstance(s, MoveTo)][-2:]  # beside the path's start, and that start
    start = near[-1]
    return (*over_pole(cup_of(test.bar), start.target_mm, start.feed_mm_min), *near, *test.steps[first:])


def anew(test: TestPlan, number: int) -> TestPlan:
    """Return the test for mounting ``number``: from the second on, the number is appended to the set-up's name."""
    if number == 1:
        return test
    return test.in_setup(f"{test.setup_id}-{number}")


def end_of(test: TestPlan) -> Point | None:
    """Return the position of the machine after a test; None if it does not move."""
    return _final_position(test.steps)


def _final_position(steps: tuple[Step, ...]) -> Point | None:
    trail = _trail(None, steps)
    return trail[-1] if trail else None


def _trail(start: Point | None, steps: tuple[Step, ...]) -> tuple[Point, ...]:
    points: list[Point] = [] if start is None else [start]
    for step in steps:
        if isinstance(step, MoveTo):
            points.append(step.target_mm)
        elif isinstance(step, RecordPath | FollowPath):
            points += step.points_mm
    return tuple(p for k, p in enumerate(points) if k == 0 or p != points[k - 1])


def _feed(steps: tuple[Step, ...]) -> float:
    """Return the slowest feed of the remaining steps: the machine never returns faster than it came."""
    return min((s.feed_mm_min for s in steps if isinstance(s, MoveTo | RecordPath | FollowPath)), default=1000.0)


def _nearest(trail: np.ndarray, here: np.ndarray, to: int, *, latest: bool) -> tuple[int, float]:
    """Return the number of the nearest segment's first point, and the distance from the segment, mm.

    If the trail passes ``here`` several times (a circle with feed-in), ``latest`` takes the last passage; without ``latest`` the passage
    nearest to ``to`` along the trail counts.
    """
    if len(trail) == 1:
        return 0, float(np.linalg.norm(here - trail[0]))
    begin, along = trail[:-1], np.diff(trail, axis=0)
    share = np.clip(((here - begin) * along).sum(axis=1) / np.maximum((along * along).sum(axis=1), 1e-18), 0.0, 1.0)
    off = np.linalg.norm(begin + share[:, None] * along - here, axis=1)
    near = np.flatnonzero(off <= off.min() + SAME_WAY_MM)
    k = int(near[-1] if latest else near[np.argmin(np.abs(near - to))])
    return k, float(off[k])
