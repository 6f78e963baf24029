"""A plan as blocks that every NC dialect can express: lines, arcs, dwells, stops for a person, comments."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from abbe.models.machine import AXES
from abbe.models.paths import PLANES
from abbe.service.domain.machine import Point
from abbe.service.errors import ConfigError
from abbe.service.sequences.steps import (
    CampaignPlan,
    ChangeBar,
    FollowPath,
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

LASER_DWELL_S = 0.7
"""Dwell for a laser reading, after settling: 14 output samples, so that a few may be lost at either end of the standstill."""
BAR_DWELL_S = 0.3
PATH_REST_S = 2.0
"""Standstill before and after a recorded path: it shows the listener where the path begins and ends."""


@dataclass(frozen=True, slots=True)
class Comment:
    """A comment for the reader of the program."""

    text: str


@dataclass(frozen=True, slots=True)
class Halt:
    """The program stops until a person has done the task in ``text``."""

    text: str


@dataclass(frozen=True, slots=True)
class Go:
    """Straight move to a point."""

    target_mm: Point
    feed_mm_min: float


@dataclass(frozen=True, slots=True)
class Arc:
    """Arc of less than a full turn in a plane of two axes; ``positive``: the arc runs from the plane's first axis to its second."""

    plane: str
    start_mm: Point
    target_mm: Point
    centre_mm: Point
    positive: bool
    feed_mm_min: float


@dataclass(frozen=True, slots=True)
class Dwell:
    """Stand still; ``reading``: number of the reading taken during it, 0 for none."""

    seconds: float
    reading: int = 0


@dataclass(frozen=True, slots=True)
class Smooth:
    """Pass corners at constant feed from here on, or (``on`` False) stop exactly in each."""

    on: bool


Block = Comment | Halt | Go | Arc | Dwell | Smooth


@dataclass(frozen=True, slots=True)
class Program:
    """An NC program: its name, the comments at its head, and its blocks."""

    name: str
    head: tuple[str, ...]
    blocks: tuple[Block, ...]

    @property
    def halts(self) -> int:
        """Number of stops for a person."""
        return sum(isinstance(block, Halt) for block in self.blocks)


def program(machine_name: str, plan: CampaignPlan, stroke_mm: Any, arcs: tuple[str, ...] = PLANES) -> Program:
    """Return the NC program of a campaign: every position of its plan in order, a dwell at each reading, a stop for each manual step.

    ``arcs``: planes in which circles become arcs. `abbe.service.sequences.nc.write` computes the run time.
    """
    moves = [s.feed_mm_min for t in plan.tests for s in t.steps if isinstance(s, MoveTo | RecordPath | FollowPath)]
    readings = sum(isinstance(s, ReadLaser | ReadBar) for t in plan.tests for s in t.steps)
    slow, fast = min(moves, default=0.0), max(moves, default=0.0)
    strokes = ", ".join(f"{a} {low:g} to {high:g}" for a, (low, high) in zip(AXES, stroke_mm, strict=True))
    head = (
        f"{plan.name}: {len(plan.tests)} tests on {machine_name}",
        f"{readings} readings at standstill, feeds {slow:g} to {fast:g} mm/min, limits in mm: {strokes}",
        "positions are machine coordinates in mm: work offsets, tool length and rotation must be zero",
        "feed override 100 percent, single block off; start abbe listen first, then this program",
    )
    count = 0
    blocks: list[Block] = []
    if any(isinstance(s, TouchFeature) for t in plan.tests for s in t.steps):
        raise ConfigError("Abbe's NC programs cannot probe an artefact", "use the control's own measuring cycles, and import their points")
    for test in plan.tests:
        blocks.append(Comment(f"test {test.label}: {test.test} in set-up {test.setup_id}"))
        for block in _test(test, arcs):
            if isinstance(block, Dwell) and block.reading:
                count += 1
                block = Dwell(block.seconds, count)
            blocks.append(block)
    return Program(plan.name, head, tuple(blocks))


def _test(test: TestPlan, arcs: tuple[str, ...]) -> Iterator[Block]:
    """Yield the blocks of a test. The cup is placed at the centre; the bar does not fit there, so it is mounted beside the path's start."""
    here: Point | None = None
    steps = test.steps
    first = next((k for k, s in enumerate(steps) if isinstance(s, RecordPath | ReadBar)), 0)
    mount = next((k for k, s in enumerate(steps) if isinstance(s, MountBar)), None)
    hang = max((k for k in range(first) if isinstance(steps[k], MoveTo)), default=0)  # before the last small move to the path's start
    feed = min((s.feed_mm_min for s in steps if isinstance(s, MoveTo | RecordPath | FollowPath)), default=0.0)
    for k, step in enumerate(steps):
        if isinstance(step, ZeroLaser) and k and isinstance(steps[k - 1], MountLaser):
            continue  # one halt for both: the listener would take a program start between them for the measurement
        if mount is not None and k == hang:
            yield Halt(f"mount the bar of {test.bar.radius_mm:g} mm")
        if mount is not None and mount < k < hang and isinstance(step, MoveTo | FollowPath):
            step = replace(step, feed_mm_min=min(step.feed_mm_min, feed))
        yield from _step(test, step, here, arcs)
        if isinstance(step, MoveTo):
            here = step.target_mm
        elif isinstance(step, RecordPath | FollowPath):
            here = step.points_mm[-1]


def _step(test: TestPlan, step: Step, here: Point | None, arcs: tuple[str, ...]) -> Iterator[Block]:
    match step:
        case MoveTo(target, feed):
            if target != here:
                yield Go(target, feed)
        case ReadLaser(_, settle):
            yield Dwell(settle + LASER_DWELL_S, 1)
        case ReadBar(_, settle, samples, rate_hz):
            yield Dwell(settle + samples / rate_hz + BAR_DWELL_S, 1)
        case RecordPath():
            yield Dwell(PATH_REST_S)
            yield Smooth(True)
            yield from _path(test, step, arcs)
            yield Smooth(False)
            yield Dwell(PATH_REST_S)
        case FollowPath(points, feed):
            yield Smooth(True)
            yield from (Go(p, feed) for a, p in pairwise(points) if p != a)
            yield Smooth(False)
        case _:
            task = _by_hand(step)
            if task:
                yield Halt(task)


def _by_hand(step: Step) -> str:
    match step:
        case MountBar():
            return "put the cup under the ball here"
        case TakeBarOut():
            return "take the bar out, leave the cup"
        case ChangeBar(radius):
            return f"mount the bar of {radius:g} mm"
        case MountLaser(beam):
            along = " ".join(f"{a}{v:+.4f}" for a, v in zip(AXES, beam, strict=True))
            return f"set up laser and mirror, beam along {along}; zero the laser"
        case Unmount():
            return "take bar, cup, mirror away"
        case ZeroLaser():
            return "zero the laser"
    return ""


def _path(test: TestPlan, step: RecordPath, arcs: tuple[str, ...]) -> Iterator[Block]:
    """Yield the blocks of a path: exact arcs for a circle, the polyline for any other path."""
    plane = test.bar.plane
    if test.test != "ballbar_circle" or plane not in arcs:
        yield from (Go(p, step.feed_mm_min) for a, p in pairwise(step.points_mm) if p != a)
        return
    points, centre = step.points_mm, test.bar.centre_mm
    a, b = ("XYZ".index(c) for c in plane)
    angles = np.unwrap(np.arctan2([p[b] - centre[b] for p in points], [p[a] - centre[a] for p in points]))
    corners = sorted({0, *(step.measured or (0, 0)), len(points) - 1})
    for first, last in pairwise(corners):
        parts = max(1, int(np.ceil(abs(angles[last] - angles[first]) / np.deg2rad(170.0))))
        at = np.unique(np.linspace(first, last, parts + 1).astype(int))
        for i, k in pairwise(at):
            positive = bool(angles[k] > angles[i])
            middle = (float(centre[0]), float(centre[1]), float(centre[2]))
            yield Arc(plane, points[i], points[k], middle, positive, step.feed_mm_min)
