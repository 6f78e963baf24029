"""Dry run of a plan: its motions, its duration, and whether it stays inside the machine - before anything moves."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from abbe.models.machine import AXES, Machine
from abbe.service.domain.machine import Point
from abbe.service.domain.run import BarSetup
from abbe.service.errors import StrokeError
from abbe.service.sequences.recipes.approach import LOW_SHARE, as_point, cup_of
from abbe.service.sequences.steps import (
    MAX_PATH_POINTS,
    CampaignPlan,
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
    ZeroLaser,
)

MOUNT_S = 0.0
"""A person's time for mounting and clearing away is not machine time; it is not counted."""


@dataclass(frozen=True, slots=True)
class DryRun:
    """One test as it would run: machine seconds, path length, extent, number of readings, largest speed."""

    label: str
    test: str
    duration_s: float
    path_mm: float
    lowest_mm: Point
    highest_mm: Point
    readings: int
    fastest_mm_min: float = 0.0


def positions(steps: tuple[Step, ...]) -> Iterator[Point]:
    """Yield every commanded position of the steps, in order."""
    for step in steps:
        if isinstance(step, MoveTo):
            yield step.target_mm
        elif isinstance(step, RecordPath | FollowPath):
            yield from step.points_mm
        elif isinstance(step, TouchFeature):
            yield from step.places_mm()


def step_seconds(step: Step, here: Point | None) -> tuple[float, Point | None]:
    """Return the machine time of a step, s, from the position ``here`` (None: unknown), and the position after it."""
    match step:
        case MoveTo(target, feed):
            return (0.0 if here is None else math.dist(here, target) / feed * 60.0), target
        case RecordPath(points, feed) | FollowPath(points, feed):
            length = sum(math.dist(a, b) for a, b in pairwise(points))
            return length / feed * 60.0, points[-1]
        case ReadBar(_, settle, samples, rate_hz):
            return settle + samples / rate_hz, here
        case ReadLaser(_, settle):
            return settle + 0.1, here
        case TouchFeature():
            return _touch_seconds(step, here), step.above_mm
        case MountArtefact() | MountBar() | TakeBarOut() | ChangeBar() | MountLaser() | Unmount() | ZeroLaser():
            return MOUNT_S, here


def _touch_seconds(step: TouchFeature, here: Point | None) -> float:
    """Time of all touches of a feature: the way there and between the sides, and the way in and out of every repeat."""
    way = sum(math.dist(a, b) for a, b in pairwise(step.places_mm())) + (0.0 if here is None else math.dist(here, step.above_mm))
    touches = len(step.sides) * step.repeats
    return 60.0 * (way / step.feed_mm_min + touches * step.search_mm * (1.0 / step.touch_feed_mm_min + 1.0 / step.feed_mm_min))


def check_positions(machine: Machine, plan: TestPlan) -> tuple[Point, Point]:
    """Return the lowest and highest commanded position of each axis, mm.

    Raises
    ------
    StrokeError
        A position lies beyond a stroke, or a path has more points than the controller's memory holds.
    """
    for step in plan.steps:
        if isinstance(step, RecordPath | FollowPath) and len(step.points_mm) > MAX_PATH_POINTS:
            raise StrokeError(
                f"test {plan.label}: the path has {len(step.points_mm)} points, the controller holds {MAX_PATH_POINTS}",
                "use a longer chord, fewer turns or a smaller radius; nothing has moved",
            )
    at = np.array(list(positions(plan.steps)), dtype=np.float64).reshape(-1, 3)
    low, high = machine.stroke_mm.T
    beyond = np.argwhere(~((low - 1e-9 <= at) & (at <= high + 1e-9)))
    if beyond.size:
        n, a = beyond[0]
        over = low[a] - at[n, a] if at[n, a] < low[a] else at[n, a] - high[a]
        raise StrokeError(
            f"test {plan.label}: {AXES[a]} would go to {at[n, a]:.3f} mm, {over:.3f} mm beyond its stroke {low[a]:g}..{high[a]:g}",
            "move the centre or the artefact, shorten the radius or correct stroke_mm in the machine file; nothing has moved",
        )
    lo, hi = at.min(axis=0, initial=math.inf).tolist(), at.max(axis=0, initial=-math.inf).tolist()
    return (lo[0], lo[1], lo[2]), (hi[0], hi[1], hi[2])


def paced(plan: CampaignPlan, max_feed_mm_min: float) -> CampaignPlan:
    """Return the same campaign, moving between readings no faster than the machine file allows.

    Positions are read at standstill, so a slower approach changes no reading. A recorded path keeps the feed of its recipe.
    """

    def slowed(step: Step) -> Step:
        if not isinstance(step, MoveTo | FollowPath | TouchFeature):
            return step
        return replace(step, feed_mm_min=min(step.feed_mm_min, max_feed_mm_min))

    return replace(plan, tests=tuple(replace(t, steps=tuple(slowed(s) for s in t.steps)) for t in plan.tests))


def dry_run(machine: Machine, plan: TestPlan, start_mm: Point | None = None) -> DryRun:
    """Check a test against the strokes and compute its duration.

    Raises
    ------
    StrokeError
        As `check_positions`; or a ball-bar goes below its cup and the recipe does not set ``under_the_cup``.
    """
    lowest, highest = check_positions(machine, plan)
    _check_cup(plan)
    seconds, length, readings, here = 0.0, 0.0, 0, start_mm
    for step in plan.steps:
        dt, after = step_seconds(step, here)
        if isinstance(step, RecordPath | FollowPath):
            length += dt * step.feed_mm_min / 60.0
            readings += int(dt * step.rate_hz) if isinstance(step, RecordPath) else 0
        elif isinstance(step, MoveTo) and here is not None:
            length += math.dist(here, step.target_mm)
        readings += isinstance(step, ReadLaser | ReadBar | TouchFeature)
        seconds, here = seconds + dt, after
    return DryRun(plan.label, plan.test, seconds, length, lowest, highest, readings, fastest(plan))


def _check_cup(plan: TestPlan) -> None:
    setup = plan.setup
    if not isinstance(setup, BarSetup) or setup.under_the_cup:
        return
    own = next(
        (k for k, s in enumerate(plan.steps) if isinstance(s, RecordPath | ReadBar)), len(plan.steps)
    )  # before: another bar's sphere
    lowest = cup_of(setup).lowest(list(positions(plan.steps[own:])) or [as_point(cup_of(setup).pole)])
    if lowest < -LOW_SHARE:
        raise StrokeError(
            f"test {plan.label}: the path goes {-lowest * setup.radius_mm:.0f} mm below the centre of the cup, into its support",
            f"use a partial arc ({LOW_SHARE:g} radii below the centre are allowed), or write under_the_cup = true if there is room",
        )


def fastest(plan: TestPlan) -> float:
    """Return the largest feed of a test, mm/min."""
    moving = MoveTo | RecordPath | FollowPath | TouchFeature
    return max((s.feed_mm_min for s in plan.steps if isinstance(s, moving)), default=0.0)


def dry_run_campaign(machine: Machine, plan: CampaignPlan, max_feed_mm_min: float = math.inf) -> tuple[DryRun, ...]:
    """Dry-run all tests of a campaign.

    Raises
    ------
    StrokeError
        A test leaves the strokes or exceeds the feed limit of the machine file.
    """
    for test in plan.tests:
        feed = fastest(test)
        if feed > max_feed_mm_min:
            raise StrokeError(
                f"test {test.label} would move at {feed:g} mm/min, the limit is {max_feed_mm_min:g}",
                "lower the recipe's feed or raise feed_mm_min under [limits]; nothing has moved",
            )
    return tuple(dry_run(machine, test) for test in plan.tests)
