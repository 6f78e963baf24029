"""Where an interrupted test resumes, and how the machine gets there. Pure.

A bar must not move through its sphere, nor a mirror out of its beam: the machine returns the way the test came, to the last checkpoint. A
ball-bar path resumes where it was interrupted (abbe.service.sequences.path_resume), or begins again. A laser run resumes after its last
complete point, once that point has been read again with the same result.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from abbe.service.errors import SetupDisturbed
from abbe.service.runs.pieces import ReadProgress
from abbe.service.sequences.path_resume import PathRemainder, rest_of_path
from abbe.service.sequences.recipes.approach import cup_of, over_pole
from abbe.service.sequences.steps import (
    ChangeBar,
    FollowPath,
    MountBar,
    MountLaser,
    MoveTo,
    Point,
    ReadBar,
    ReadLaser,
    RecordPath,
    Step,
    TakeBarOut,
    TestPlan,
    Unmount,
)

BY_HAND = MountBar | TakeBarOut | ChangeBar | MountLaser | Unmount
STANDS = MountBar | TakeBarOut | ChangeBar | MountLaser
"""Steps after which the machine holds a bar, a cup or a mirror."""
OFF_PATH_MM = 0.05
"""Farther than this from the way it came, another program or person moved the machine, and the set-up is not reliable."""
SAME_WAY_MM = 0.005
"""Tolerance for two passages of one place: chords of a circle run beside it, and positions are rounded."""
KEEP_FROM = 2
"""A laser run with fewer complete points begins again: a repeated reading has nothing to be compared with."""
REFERENCE_MM = 0.003
"""Allowed difference of the repeated reading: minutes of drift and noise, but not a displaced mirror."""


@dataclass(frozen=True, slots=True)
class ResumeTrail:
    """How to resume: along ``trail`` (oldest point first) back to number ``to``, then forward to number ``upto``.

    With ``carried`` records the last of them is read again there. On the way forward every axis moves as before, so that its lost motion is
    the same. ``latest``: where the trail passes a place twice, the machine stands on the later passage. Empty trail: nothing is mounted.
    Trail of one point: the machine must stand there, and nothing moves.
    """

    trail: tuple[Point, ...] = ()
    to: int = 0
    upto: int = 0
    feed_mm_min: float = 1000.0
    latest: bool = False
    carried: tuple[dict[str, Any], ...] = ()


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
        Last manual step done; None: none.
    records : tuple of dict
        Laser records of complete points since this mounting's zero, oldest first; none for a ball-bar.
    before : tuple of float, optional
        End position of the previous test, if both share the set-up.
    so_far : ReadProgress, optional
        How far the path was read in this mounting.
    """
    first = 0 if hand is None else hand + 1
    start = before if hand is None else _standing(test.steps[:first])
    if hand is not None and isinstance(test.steps[hand], TakeBarOut) and start is None:
        start = before
    steps = test.steps[first:]
    if len(records) >= KEEP_FROM and not any(isinstance(s, RecordPath | ReadBar) for s in steps):
        return _after_point(test, first, records)
    stands = start is not None and (hand is None or isinstance(test.steps[hand], STANDS))
    if not stands:
        return replace(test, steps=steps), first, ResumeTrail(), None
    if so_far is not None and (found := _along_path(test, first, start, so_far)) is not None:
        return found
    return replace(test, steps=steps), first, _to_beginning(_trail(start, _by_itself(steps)), steps), None


def _along_path(test: TestPlan, first: int, start: Point | None, so_far: ReadProgress) -> Rest | None:
    """Return the rest that begins on the path, or None."""
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
    """Return along the trail to the start of the first remaining step or, if that is a straight move, to its end."""
    to = 0 if isinstance(steps[0], FollowPath | RecordPath) else min(1, len(trail) - 1)
    return ResumeTrail(trail, to, to, _feed(steps))


def _by_itself(steps: tuple[Step, ...]) -> tuple[Step, ...]:
    """Steps before the first manual one: after it the set-up, and so the way, is another."""
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


def _all_axes_from(trail: tuple[Point, ...]) -> int:
    """Number of the point from which every moving axis makes its last motion to the trail's end."""
    moved = np.abs(np.diff(np.array(trail), axis=0)) > 0.0
    return min((int(np.flatnonzero(moved[:, a])[-1]) for a in range(3) if moved[:, a].any()), default=len(trail) - 1)


def way_back(resume_trail: ResumeTrail, position_mm: Point) -> tuple[Point, ...]:
    """Return the positions to pass through from the current one. Raises SetupDisturbed if the machine is not on the way it came."""
    if not resume_trail.trail:
        return ()
    trail, here = np.array(resume_trail.trail), np.array(position_mm)
    segment, off_mm = _nearest(trail, here, resume_trail.to, latest=resume_trail.latest)
    if off_mm > OFF_PATH_MM:
        raise SetupDisturbed(
            f"the machine stands {off_mm:.3f} mm beside the way that the test came",
            "it was moved during the break: the set-up is mounted anew",
        )
    if len(trail) == 1:
        return ()
    way, to = resume_trail.trail, resume_trail.to
    points = way[to : segment + 1][::-1] or way[segment + 1 : to + 1]  # the machine may also stand before ``to``
    return tuple(p for k, p in enumerate(points) if k or np.abs(np.array(p) - here).max() > 1e-5)


def remounted(test: TestPlan, first: TestPlan, number: int) -> TestPlan:
    """Return a test that itself mounts its set-up for the n-th time; ``first`` is the test that mounted it the first time."""
    named = anew(test, number)
    if test.mounts:
        return replace(named, steps=(Unmount(), *test.steps))
    k = next((k for k, step in enumerate(first.steps) if isinstance(step, MountBar | MountLaser)), None)
    if k is None:
        raise SetupDisturbed(
            f"another campaign mounted the set-up of test {test.label}, and this one cannot mount it anew",
            "clear it away and begin again",
        )
    opening: tuple[Step, ...] = (Unmount(), *(s for s in first.steps[: k + 1] if not isinstance(s, Unmount)))
    if not any(isinstance(step, MountBar) for step in opening):
        return replace(named, steps=(*opening, *test.steps))
    return replace(named, steps=(*opening[:-1], MountBar(test.setup["radius_mm"]), *_from_centre(test)))


def _from_centre(test: TestPlan) -> tuple[Step, ...]:
    """Steps of a test whose bar is hung in anew at the centre: over the pole instead of from the end of the previous test."""
    first = next(k for k, step in enumerate(test.steps) if isinstance(step, RecordPath | ReadBar))
    near = [s for s in test.steps[:first] if isinstance(s, MoveTo)][-2:]  # beside the path's start, and that start
    start = near[-1]
    return (*over_pole(cup_of(test.setup), start.target_mm, start.feed_mm_min), *near, *test.steps[first:])


def anew(test: TestPlan, number: int) -> TestPlan:
    """Return a test whose set-up carries the number of its mounting in its name."""
    if number == 1:
        return test
    return replace(test, setup=test.setup | {"setup_id": f"{test.setup['setup_id']}-{number}"})


def end_of(test: TestPlan) -> Point | None:
    """Position of the machine after a test."""
    return _standing(test.steps)


def _standing(steps: tuple[Step, ...]) -> Point | None:
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
    """Slowest feed of the remaining steps: the machine never returns faster than it came."""
    return min((s.feed_mm_min for s in steps if isinstance(s, MoveTo | RecordPath | FollowPath)), default=1000.0)


def _nearest(trail: np.ndarray, here: np.ndarray, to: int, *, latest: bool) -> tuple[int, float]:
    """Return the number of the nearest segment's first point, and the distance from the segment, mm.

    Where the trail passes the place more than once (a circle with feed-in), take the passage nearest to ``to`` along the trail.
    """
    if len(trail) == 1:
        return 0, float(np.linalg.norm(here - trail[0]))
    begin, along = trail[:-1], np.diff(trail, axis=0)
    share = np.clip(((here - begin) * along).sum(axis=1) / np.maximum((along * along).sum(axis=1), 1e-18), 0.0, 1.0)
    off = np.linalg.norm(begin + share[:, None] * along - here, axis=1)
    near = np.flatnonzero(off <= off.min() + SAME_WAY_MM)
    k = int(near[-1] if latest else near[np.argmin(np.abs(near - to))])
    return k, float(off[k])
