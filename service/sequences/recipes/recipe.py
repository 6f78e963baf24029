"""Recipes: the parameters of a test; `plan` turns them into steps.

Every axis approaches the first position in the direction of its first motion, so that its lost motion is in a known state at the start;
this is impossible for an axis that begins at the very end of its stroke. A test that mounts something clears it away at the end.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, asdict, dataclass
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from pydantic import Field as Limits

from abbe.models.machine import AXES, Machine
from abbe.models.paths import (
    Law,
    Plane,
    arc_through,
    circle_points,
    cycles_of,
    diagonal_ends,
    even_helix_points,
    face_ends,
    helix_points,
    step_diagonal,
    straight_line,
    target_shares,
    way_on_sphere,
)
from abbe.service.domain.document import Doc
from abbe.service.domain.machine import Point
from abbe.service.domain.run import parsed_setup
from abbe.service.errors import ConfigError
from abbe.service.sequences.recipes.approach import (
    BAR_APPROACH_MM,
    LINK_CHORD_MM,
    RAPID_MM_MIN,
    Array,
    AxisIndex,
    CupTest,
    Feed,
    Flat,
    Rate,
    Settle,
    Share,
    TestRecipe,
    as_point,
    as_points,
    inner,
    one_of,
    pole_of,
    to_path,
)
from abbe.service.sequences.recipes.artefact import ArtefactTest
from abbe.service.sequences.steps import (
    MAX_PATH_POINTS,
    FollowPath,
    MountLaser,
    MoveTo,
    ReadBar,
    ReadLaser,
    RecordPath,
    Step,
    TestPlan,
    Unmount,
    ZeroLaser,
)

MIN_TURNS = 3.0
"""With fewer turns cup offset, scale and squareness are hardly separated (condition number 28 at 3 turns, 58 at 2, 1900 at 1)."""
PARTIAL_DEG, PARTIAL_LEAD_DEG = 220.0, 2.0
"""Span of the partial arc of ISO 230-4, degrees, and of each of its feed-in and feed-out."""
Turns = Annotated[float, Limits(ge=3.0, le=50.0)]
Lead = Annotated[float, Limits(ge=0.0, le=90.0)]
Arc = Annotated[float, Limits(ge=0.0, le=360.0)]
Path = tuple[tuple[Point, ...], tuple[int, int] | None]
"""Points of a path, and the numbers of the first and last measured point; None: all."""


def joined(arcs: tuple[Array, Array, Array]) -> Path:
    """Join feed-in, measured part and feed-out, whose ends coincide, into one path."""
    lead, middle, tail = arcs
    points = np.concatenate([lead[:-1], middle, tail[1:]])
    first = max(len(lead) - 1, 0)
    whole = len(lead) <= 1 and len(tail) <= 1
    return as_points(points), None if whole else (first, first + len(middle) - 1)


@dataclass(frozen=True, slots=True)
class Helix(CupTest):
    """Hemispherical helix of the ball-bar test: continuous at constant feed, from pole to equator or (direction -1) back.

    ``chord_mm`` is the wanted mean spacing of the path's points; a long path gets longer chords to fit into the controller's memory.
    Between its n points the polyline lies inside the sphere, by up to c^2 / (8 radius) with c the real chord (1.3 um for a radius of
    750 mm); near the pole by radius / (4 n) if ``law`` is "area" (23 um). Columns and solvers use the commanded position on the polyline,
    not on the sphere: this costs accuracy only if the position of a sample is uncertain by a part of a chord. ``even``: almost equal
    spacing along the same curve.
    ``feed_in_deg`` and ``feed_out_deg``: arcs of the great circles tangent to the path's ends, driven continuously with it, so that the
    recorded part is at constant feed; ``feed_in_deg`` comes first in either direction.
    """

    _: KW_ONLY
    turns: Turns = 5.0
    law: Law = "area"
    feed_in_deg: Lead = 0.0
    feed_out_deg: Lead = 0.0
    kind: Literal["helix"] = "helix"
    chord_mm: float = inner(1.0)
    even: bool = inner(False)

    def path(self) -> Path:
        """Return all points in the order of driving, feed-in and feed-out included."""
        length = 2 * np.pi * self.radius_mm * self.turns
        arcs = np.deg2rad([self.feed_in_deg, self.feed_out_deg])
        lead, tail = (int(np.ceil(self.radius_mm * a / self.chord_mm)) for a in arcs)
        n = min(max(64, int(length / self.chord_mm)), MAX_PATH_POINTS - lead - tail)
        draw = even_helix_points if self.even else helix_points
        curve = draw(np.array(self.centre_mm), self.radius_mm, turns=self.turns, n=n, law=self.law, axis=self.axis)
        if self.opens < 0:  # seen in a mirror across the equator
            curve[:, self.axis] = 2.0 * self.centre_mm[self.axis] - curve[:, self.axis]
        if self.direction < 0:
            curve = curve[::-1]
        centre = np.array(self.centre_mm)
        first = arc_through(centre, curve[0], curve[1] - curve[0], np.linspace(-arcs[0], 0.0, lead + 1))
        last = arc_through(centre, curve[-1], curve[-1] - curve[-2], np.linspace(0.0, arcs[1], tail + 1))
        return joined((first, curve, last))

    def plan(self, machine: Machine) -> TestPlan:
        """Return the test with its steps: to the centre, mount, out to the path's start, record the path, clear away.

        Raises
        ------
        ConfigError
            Fewer than three turns: the solution would be ill-conditioned.
        """
        _check_turns(self.label, self.turns)
        path, measured = self.path()
        steps = to_path(self, path, machine)
        steps.append(RecordPath(path, self.feed_mm_min, self.rate_hz, self.direction, measured))
        if self.unmount:
            steps.append(Unmount())
        # everything needed to drive the same path again
        again = {"law": self.law, "even": self.even, "chord_mm": self.chord_mm, "rate_hz": self.rate_hz}
        if measured is not None:
            again |= {"feed_in_deg": self.feed_in_deg, "feed_out_deg": self.feed_out_deg}
        return _bar_plan(self, "ballbar_helix", machine, {"turns": self.turns}, again, steps)


@dataclass(frozen=True, slots=True)
class HelixPoints(CupTest):
    """The helix of `Helix` point by point: ``points`` positions from pole to equator (direction -1: back), each read at standstill.

    Between two positions the machine moves along the sphere, so that the bar stays within its stroke. It stops half a millimetre before
    the next position, against the motion of each axis, and moves there straight: every axis arrives in its direction of travel between
    positions. The reading is the mean of ``samples`` samples of the bar, taken after ``settle_s``.
    """

    _: KW_ONLY
    turns: Turns = 5.0
    law: Law = "area"
    points: Annotated[int, Limits(ge=20, le=2000)] = 120
    rate_hz: Rate = 1000
    settle_s: Settle = 0.3
    samples: Annotated[int, Limits(ge=1, le=1000)] = 20
    kind: Literal["helix_points"] = "helix_points"

    def path(self) -> Path:
        """Return the positions in the order of reading."""
        curve = helix_points(np.array(self.centre_mm), self.radius_mm, turns=self.turns, n=self.points, law=self.law, axis=self.axis)
        if self.opens < 0:
            curve[:, self.axis] = 2.0 * self.centre_mm[self.axis] - curve[:, self.axis]
        return as_points(curve[:: self.direction]), None

    def plan(self, machine: Machine) -> TestPlan:
        """Return the test with its steps: to the centre, mount, out to the first position; read and move along the sphere; clear away.

        Raises as `Helix.plan`.
        """
        _check_turns(self.label, self.turns)
        path, _ = self.path()
        up = pole_of(self)[1]
        reading = ReadBar(self.direction, self.settle_s, self.samples, self.rate_hz)
        steps: list[Step] = [*to_path(self, path, machine), reading]
        for here, there in pairwise(path):
            moved = np.sign(np.subtract(there, here))
            stop = np.clip(np.array(there) - BAR_APPROACH_MM * moved, machine.stroke_mm[:, 0], machine.stroke_mm[:, 1])
            way = way_on_sphere(np.array(self.centre_mm), np.array(here), np.array(there), up, LINK_CHORD_MM)
            steps.append(FollowPath((*(as_point(p) for p in way[:-1]), as_point(stop)), self.feed_mm_min))
            steps += [MoveTo(there, self.feed_mm_min), reading]
        if self.unmount:
            steps.append(Unmount())
        again = {"law": self.law, "points": self.points, "settle_s": self.settle_s, "samples": self.samples, "rate_hz": self.rate_hz}
        return _bar_plan(self, "ballbar_helix", machine, {"turns": self.turns}, again, steps)


@dataclass(frozen=True, slots=True, kw_only=True)
class CircleArc:
    """The arc of a circular test, degrees."""

    begin_deg: float
    span_deg: float
    feed_in_deg: float
    feed_out_deg: float


@dataclass(frozen=True, slots=True)
class Circle(CupTest):
    """Circular test (ISO 230-4) in the plane of two axes: ``span_deg`` from ``start_deg``, angles from the plane's first axis to its
    second.

    ``direction`` 1: increasing angles; -1: the same arc back. ``feed_in_deg`` and ``feed_out_deg`` extend the arc along the same circle
    outside the measured part (ISO 230-4: 180 degrees for a full circle). By default the plane normal to ``axis`` has a full circle from
    0 degrees. The two planes that contain ``axis`` have the partial arc of 220 degrees about the pole, with 2 degrees before and after
    it: the cup's support is below. ``under_the_cup``: lower points are wanted, and the user has checked that there is room. The machine
    moves over the pole between two arcs about one cup.
    """

    plane: Plane
    start_deg: Annotated[float, Limits(ge=-360.0, le=360.0)] | None = None
    span_deg: Annotated[float, Limits(ge=30.0, le=720.0)] | None = None
    feed_in_deg: Arc | None = None
    feed_out_deg: Arc | None = None
    _: KW_ONLY
    under_the_cup: bool = False
    feed_mm_min: Feed = 1000.0
    kind: Literal["circle"] = "circle"
    chord_mm: float = inner(0.5)

    def arc(self) -> CircleArc:
        """Return start, span, feed-in and feed-out of the arc, degrees, with defaults for fields without a value."""
        upright = AXES[self.axis] in self.plane
        span = self.span_deg if self.span_deg is not None else PARTIAL_DEG if upright else 360.0
        pole = (0.0 if self.plane[0] == AXES[self.axis] else 90.0) + (0.0 if self.opens > 0 else 180.0)
        begin = self.start_deg if self.start_deg is not None else pole - 0.5 * span if upright else 0.0
        lead = PARTIAL_LEAD_DEG if upright else 180.0
        return CircleArc(
            begin_deg=begin if begin < 180.0 else begin - 360.0,
            span_deg=span,
            feed_in_deg=lead if self.feed_in_deg is None else self.feed_in_deg,
            feed_out_deg=lead if self.feed_out_deg is None else self.feed_out_deg,
        )

    def path(self) -> Path:
        """Return all points in the order of driving, feed-in and feed-out included."""
        turn, arc = float(self.direction), self.arc()
        first = arc.begin_deg if turn > 0 else arc.begin_deg + arc.span_deg
        parts = np.array([arc.feed_in_deg, arc.span_deg, arc.feed_out_deg])
        chord = max(self.chord_mm, np.deg2rad(parts.sum()) * self.radius_mm / (MAX_PATH_POINTS - 6))
        begin = first - turn * arc.feed_in_deg
        arcs = []
        for span in parts:
            n = int(np.ceil(np.deg2rad(span) * self.radius_mm / chord))
            angles = np.deg2rad(begin + turn * np.linspace(0.0, span, n + 1))
            arcs.append(circle_points(np.array(self.centre_mm), self.radius_mm, self.plane, angles))
            begin += turn * span
        return joined((arcs[0], arcs[1], arcs[2]))

    def plan(self, machine: Machine) -> TestPlan:
        """Return the test with its steps: to the centre, mount, out to the path's start, record the path, clear away."""
        path, measured = self.path()
        steps = to_path(self, path, machine)
        steps.append(RecordPath(path, self.feed_mm_min, self.rate_hz, self.direction, measured))
        if self.unmount:
            steps.append(Unmount())
        own = {"plane": self.plane, **asdict(self.arc()), "chord_mm": self.chord_mm, "rate_hz": self.rate_hz}
        own |= {"under_the_cup": True} if self.under_the_cup else {}
        return _bar_plan(self, "ballbar_circle", machine, {}, own, steps)


BarRecipe = Helix | HelixPoints | Circle


def _bar_plan(recipe: BarRecipe, test: str, machine: Machine, path: Doc, again: Doc, steps: list[Step]) -> TestPlan:
    """Return the plan of a ball-bar test; ``again``: further values that are needed to drive the same path again."""
    setup = {
        "setup_id": recipe.setup_id,
        "centre_mm": list(recipe.centre_mm),
        "radius_mm": recipe.radius_mm,
        **path,
        "length_calibrated": recipe.length_calibrated,
        "u_length_mm": recipe.u_length_mm,
        "tool_mm": [float(v) for v in machine.tool_mm],
        "axis": AXES[recipe.axis],
        "opens": recipe.opens,
    }
    return TestPlan(recipe.label, test, recipe.role, parsed_setup(test, setup | again), tuple(steps))


def _check_turns(label: str, turns: float) -> None:
    if not MIN_TURNS <= turns < np.inf:
        raise ConfigError(
            f"test {label}: cup offset and squareness cannot be separated with {turns:g} turns: a helix needs {MIN_TURNS:g} or more",
            f"set turns to {MIN_TURNS:g} or more; 5 are usual",
        )


APPROACH_MM = 1.0
CLEARANCE_MM = 10.0
"""Laser lines keep this distance from the ends of the strokes, so that the approach and an overrun stay inside them."""


Steps = Annotated[int, Limits(ge=1, le=500)]


@dataclass(frozen=True, slots=True)
class BeamTest(TestRecipe):
    """A laser test along one line, out and back.

    ``cycles``: repetitions in one run (ISO 230-2: five). ``overrun_mm``: distance of the turning points beyond both ends, so that the
    machine approaches every position in the direction of its leg; the turning points are read, too.
    """

    _: KW_ONLY
    feed_mm_min: Feed = RAPID_MM_MIN
    settle_s: Settle = 0.3
    cycles: Annotated[int, Limits(ge=1, le=50)] = 1
    overrun_mm: Annotated[float, Limits(ge=0.0, le=8.0)] = 0.0


@dataclass(frozen=True, slots=True)
class Diagonal(BeamTest):
    """Body diagonal by laser: sequential single-axis ``steps`` (Wang), or plain positions when ``order`` is empty; out and back.

    Only plain positions may have an overrun.
    """

    diagonal: Annotated[str, one_of("ppp", "npp", "pnp", "ppn")]
    steps: Steps = 12
    order: Annotated[str, one_of("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")] = ""
    kind: Literal["diagonal"] = "diagonal"

    def plan(self, machine: Machine) -> TestPlan:
        """Return the test with its steps: approach, mount, zero, one reading after every move, clear away.

        Raises
        ------
        ConfigError
            A step diagonal with an overrun: its turning points have no approach direction.
        """
        if self.order and self.overrun_mm:
            raise ConfigError(f"test {self.label}: a step diagonal has no overrun", "remove overrun_mm or order")
        box = machine.stroke_mm + np.array([CLEARANCE_MM, -CLEARANCE_MM])
        start, end = diagonal_ends(box, self.diagonal)
        if self.order:
            out = step_diagonal(start, end, self.steps, self.order, back=False)
        else:
            out = straight_line(start, end, self.steps + 1, back=False)
        setup = {"diagonal": self.diagonal, "steps": self.steps} | ({"order": self.order} if self.order else {})
        return _laser_plan(self, "laser_diagonal", setup | _increment(out, self.steps), out)


@dataclass(frozen=True, slots=True)
class FaceDiagonal(BeamTest):
    """Diagonal of a plane of two axes by laser (ISO 230-6 has two in each of three planes), with the third axis at rest.

    ``at_share``: relative position of the third axis in its stroke. ``diagonal``: ``pp`` both axes of the plane increase, ``np`` the first
    decreases. The run is stored as a ``laser_diagonal``: the letter of the third axis in ``diagonal`` is p, and ``face`` names the plane.
    """

    plane: Flat
    diagonal: Annotated[str, one_of("pp", "np")]
    _: KW_ONLY
    at_share: Share = 0.5
    steps: Steps = 12
    kind: Literal["face"] = "face"

    def plan(self, machine: Machine) -> TestPlan:
        """Return the test with its steps: approach, mount, zero, one reading after every move, clear away."""
        box = machine.stroke_mm + np.array([CLEARANCE_MM, -CLEARANCE_MM])
        start, end = face_ends(box, self.plane, self.diagonal, self.at_share)
        letters = ["p", "p", "p"]
        letters["XYZ".index(self.plane[0])] = self.diagonal[0]
        out = straight_line(start, end, self.steps + 1, back=False)
        setup = {"diagonal": "".join(letters), "face": self.plane, "steps": self.steps}
        return _laser_plan(self, "laser_diagonal", setup | _increment(out, self.steps), out)


@dataclass(frozen=True, slots=True)
class Linear(BeamTest):
    """Single-axis positioning by laser (ISO 230-2), with this number of ``positions`` out and back.

    ``at_share``: relative positions in the strokes of the two other axes, in the order X, Y, Z. ``offset_share``: largest pseudo-random
    shift of a position, as a share of the interval, to reveal periodic errors (ISO 230-2); ``seed``: seed of the random numbers.
    """

    axis: AxisIndex
    _: KW_ONLY
    at_share: tuple[Share, Share]
    positions: Annotated[int, Limits(ge=5, le=1000)] = 25
    offset_share: Annotated[float, Limits(ge=0.0, le=0.4)] = 0.0
    seed: Annotated[int, Limits(ge=0, le=2**31)] = 1
    kind: Literal["line"] = "line"

    def plan(self, machine: Machine) -> TestPlan:
        """Return the test with its steps: approach, mount, zero, one reading after every move, clear away."""
        others = [a for a in range(3) if a != self.axis]
        start = machine.stroke_mm[:, 0].copy()
        start[others] += np.array(self.at_share) * machine.length_mm[others]
        end = start.copy()
        start[self.axis], end[self.axis] = machine.stroke_mm[self.axis] + np.array([CLEARANCE_MM, -CLEARANCE_MM])
        out = straight_line(start, end, self.positions, back=False)
        if self.offset_share:
            out = start + target_shares(self.positions, self.offset_share, self.seed)[:, None] * (end - start)
        return _laser_plan(self, "laser_linear", {"axis": AXES[self.axis]}, out)


LaserRecipe = Diagonal | FaceDiagonal | Linear


def _increment(out: Array, steps: int) -> Doc:
    """Return the field ``increment_mm``: length of one step in X, Y and Z; an overrun is not a step."""
    return {"increment_mm": [float(v) for v in (out[-1] - out[0]) / steps]}


def _laser_plan(recipe: LaserRecipe, test: str, own: Doc, out: Array) -> TestPlan:
    places, directions = cycles_of(out, recipe.cycles, recipe.overrun_mm)
    path = [as_point(p) for p in places]
    far = int(np.argmax(np.linalg.norm(places - places[0], axis=1)))
    start, end = places[0], places[far]
    beam = (end - start) / np.linalg.norm(end - start)
    approach = start - APPROACH_MM * np.sign(np.round(end - start, 9))
    steps: list[Step] = [MoveTo(as_point(approach), RAPID_MM_MIN), MoveTo(path[0], recipe.feed_mm_min)]
    if recipe.mount:
        steps.append(MountLaser((float(beam[0]), float(beam[1]), float(beam[2]))))
    steps += [ZeroLaser(), ReadLaser(1, recipe.settle_s)]
    for k, p in enumerate(path[1:], start=1):
        if p != path[k - 1]:
            steps.append(MoveTo(p, recipe.feed_mm_min))
        steps.append(ReadLaser(1 if directions[k] > 0 else -1, recipe.settle_s))
    if recipe.unmount:
        steps.append(Unmount())
    setup: Doc = {"setup_id": recipe.setup_id} | own
    setup |= {"start_mm": list(path[0]), "end_mm": list(path[far]), "nominal_beam": [float(v) for v in beam]}
    if recipe.cycles > 1 or recipe.overrun_mm:
        setup |= {"cycles": recipe.cycles, "overrun_mm": recipe.overrun_mm}
    return TestPlan(recipe.label, test, recipe.role, parsed_setup(test, setup), tuple(steps))


Recipe = BarRecipe | LaserRecipe | ArtefactTest
