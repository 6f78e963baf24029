"""Recipes: a few numbers that say which test; `plan` turns each into steps.

Every sequence approaches its first position in the direction of its first motion, each axis for itself, so that lost motion is in a known
state at the start; an axis that begins at the very end of its stroke cannot. Whoever mounts something has it taken away again at the end.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from models.machine import AXES, Machine
from models.paths.helix import Law, even_helix_points, helix_points
from models.paths.lines import diagonal_ends, step_diagonal, straight_line
from service.errors import ConfigError
from service.sequences.steps import (
    MAX_PATH_POINTS,
    ChangeBar,
    MountBar,
    MountLaser,
    MoveTo,
    Point,
    ReadLaser,
    RecordPath,
    Step,
    TakeBarOut,
    TestPlan,
    Unmount,
    ZeroLaser,
)

Array = NDArray[np.float64]
RAPID_MM_MIN = 6000.0
APPROACH_MM = 1.0
BAR_APPROACH_MM = 0.5
"""With the bar hung in: far more than any lost motion, and the bar stays within its stroke of 1 mm either way."""
MIN_TURNS = 3.0
"""Below, a hemisphere hardly tells cup offset, scale and squareness apart (condition 28 at 3 turns, 58 at 2, 1900 at 1; math.md 4.5)."""
CLEARANCE_MM = 10.0
"""Laser lines keep this distance from the ends of the strokes, so that the approach stays inside them."""


def as_point(v: Array) -> Point:
    """Three floats on the controller's 10 nm grid."""
    x, y, z = (round(float(c), 5) for c in v)
    return (x, y, z)


@dataclass(frozen=True, slots=True)
class Helix:
    """Hemispherical helix of the ball-bar test (math.md 4.3): continuous, constant feed, pole to equator or (direction -1) back.

    ``chord_mm`` is the wanted mean distance of the path's points; a long path gets longer chords, so that the controller can hold it. The
    polyline then runs chord^2 / (8 radius) inside the sphere, and by the area law radius / (4 n) beside the pole: with 750 mm, 1.3 and
    23 um. Columns and solvers take the commanded position on the polyline, not on the sphere: that costs accuracy only
    where a sample's place on the path is uncertain by a part of a chord. ``even``: points almost equally far apart along the same curve.
    ``mount`` and ``unmount`` are false where two helices in a row share one set-up: the second does not mount, the first leaves the bar.
    ``change_bar``: the second has another radius; the cup stays, the bar is taken out before the machine moves and the other one is hung in
    where its path starts. ``opens``: the pole is on the positive (1) or negative (-1) side of ``axis``, where the spindle is.
    ``u_length_mm``: standard uncertainty of the bar's length on its certificate; not ``length_calibrated``: nobody measured it.
    """

    label: str
    setup_id: str
    role: str
    centre_mm: Point
    radius_mm: float
    turns: float = 5.0
    law: Law = "area"
    axis: int = 2
    feed_mm_min: float = 2000.0
    direction: Literal[1, -1] = 1
    rate_hz: int = 100
    chord_mm: float = 1.0
    mount: bool = True
    unmount: bool = True
    change_bar: bool = False
    opens: Literal[1, -1] = 1
    length_calibrated: bool = True
    u_length_mm: float = 0.002
    even: bool = False

    def plan(self, machine: Machine) -> TestPlan:
        """Steps: to the centre, mount, out to the path's start, record the path, clear away.

        Raises
        ------
        ConfigError
            Fewer than three turns: their solution would be no measurement.
        """
        if not MIN_TURNS <= self.turns < np.inf:
            raise ConfigError(
                f"test {self.label}: {self.turns:g} turns do not tell cup offset from squareness, a helix needs {MIN_TURNS:g} or more",
                "set turns to 3 or more; 5 are usual",
            )
        length = 2 * np.pi * self.radius_mm * self.turns
        n = min(max(64, int(length / self.chord_mm)), MAX_PATH_POINTS)
        draw = even_helix_points if self.even else helix_points
        points = draw(np.array(self.centre_mm), self.radius_mm, turns=self.turns, n=n, law=self.law, axis=self.axis)
        if self.opens < 0:  # seen in a mirror across the equator
            points[:, self.axis] = 2.0 * self.centre_mm[self.axis] - points[:, self.axis]
        pole = as_point(points[0])
        path = tuple(as_point(p) for p in (points if self.direction > 0 else points[::-1]))
        start = MoveTo(_before(path, machine), RAPID_MM_MIN)
        steps: list[Step] = []
        if self.mount:
            steps += [MoveTo(self.centre_mm, RAPID_MM_MIN), MountBar(self.radius_mm), start]
        elif self.change_bar:  # by way of the pole: straight from equator to equator leads through the cup
            steps += [TakeBarOut(), MoveTo(pole, RAPID_MM_MIN), start, ChangeBar(self.radius_mm)]
        else:
            steps.append(start)
        steps.append(MoveTo(path[0], self.feed_mm_min))
        steps.append(RecordPath(path, self.feed_mm_min, self.rate_hz, self.direction))
        if self.unmount:
            steps.append(Unmount())
        setup = {
            "setup_id": self.setup_id,
            "centre_mm": list(self.centre_mm),
            "radius_mm": self.radius_mm,
            "turns": self.turns,
            "length_calibrated": self.length_calibrated,
            "u_length_mm": self.u_length_mm,
            "tool_mm": [float(v) for v in machine.tool_mm],
            # what it takes to drive the same path again
            "axis": AXES[self.axis],
            "opens": self.opens,
            "law": self.law,
            "even": self.even,
            "chord_mm": self.chord_mm,
            "rate_hz": self.rate_hz,
        }
        return TestPlan(self.label, "ballbar_helix", self.role, setup, tuple(steps))


@dataclass(frozen=True, slots=True)
class Diagonal:
    """Body diagonal by laser: sequential single-axis ``steps`` (Wang), or plain positions when ``order`` is empty; out and back.

    ``mount`` and ``unmount`` are false where two orders in a row share one mirror: the second does not mount, the first leaves it.
    """

    label: str
    setup_id: str
    role: str
    diagonal: str
    steps: int = 12
    order: str = "XYZ"
    feed_mm_min: float = RAPID_MM_MIN
    settle_s: float = 0.3
    mount: bool = True
    unmount: bool = True

    def plan(self, machine: Machine) -> TestPlan:
        """Steps: approach, mount, zero, one reading after every move, clear away."""
        box = machine.stroke_mm + np.array([CLEARANCE_MM, -CLEARANCE_MM])
        start, end = diagonal_ends(box, self.diagonal)
        sequential = bool(self.order)
        points = step_diagonal(start, end, self.steps, self.order) if sequential else straight_line(start, end, self.steps + 1)
        setup: dict[str, Any] = {
            "setup_id": self.setup_id,
            "diagonal": self.diagonal,
            "increment_mm": [float(v) for v in (end - start) / self.steps],
            "steps": self.steps,
        }
        if sequential:
            setup["order"] = self.order
        return _laser_plan(self, "laser_diagonal", setup, points, start, end)


@dataclass(frozen=True, slots=True)
class Linear:
    """Single-axis positioning by laser (ISO 230-2 line), ``n`` positions out and back, at relative place ``at`` of the other strokes.

    ``at``: one place for both other axes, or one for each in the order X, Y, Z.
    """

    label: str
    setup_id: str
    role: str
    axis: int
    n: int = 21
    at: float | tuple[float, float] = 0.15
    feed_mm_min: float = RAPID_MM_MIN
    settle_s: float = 0.3
    mount: bool = True
    unmount: bool = True

    def plan(self, machine: Machine) -> TestPlan:
        """Steps: approach, mount, zero, one reading after every move, clear away."""
        others = [a for a in range(3) if a != self.axis]
        start = machine.stroke_mm[:, 0].copy()
        start[others] += np.array(self.at) * machine.length_mm[others]
        end = start.copy()
        start[self.axis], end[self.axis] = machine.stroke_mm[self.axis] + np.array([CLEARANCE_MM, -CLEARANCE_MM])
        setup = {"setup_id": self.setup_id, "axis": AXES[self.axis]}
        return _laser_plan(self, "laser_linear", setup, straight_line(start, end, self.n), start, end)


Recipe = Helix | Diagonal | Linear


def _before(path: tuple[Point, ...], machine: Machine) -> Point:
    """Where to come from: beside the path's start, against the first motion of each axis, inside the strokes."""
    points = np.array(path)
    steps = np.diff(points, axis=0)
    first = np.array([next((np.sign(s) for s in steps[:, a] if s), 0.0) for a in range(3)])
    return as_point(np.clip(points[0] - BAR_APPROACH_MM * first, machine.stroke_mm[:, 0], machine.stroke_mm[:, 1]))


def _laser_plan(recipe: Diagonal | Linear, test: str, setup: dict[str, Any], points: Array, start: Array, end: Array) -> TestPlan:
    path = [as_point(p) for p in points]
    beam = (end - start) / np.linalg.norm(end - start)
    approach = start - APPROACH_MM * np.sign(end - start)
    half = len(path) // 2
    steps: list[Step] = [MoveTo(as_point(approach), RAPID_MM_MIN), MoveTo(path[0], recipe.feed_mm_min)]
    if recipe.mount:
        steps.append(MountLaser((float(beam[0]), float(beam[1]), float(beam[2]))))
    steps += [ZeroLaser(), ReadLaser(1, recipe.settle_s)]
    for k, p in enumerate(path[1:], start=1):
        if p != path[k - 1]:
            steps.append(MoveTo(p, recipe.feed_mm_min))
        steps.append(ReadLaser(1 if k < half else -1, recipe.settle_s))
    if recipe.unmount:
        steps.append(Unmount())
    setup |= {"start_mm": list(path[0]), "end_mm": list(as_point(end)), "nominal_beam": [float(v) for v in beam]}
    return TestPlan(recipe.label, test, recipe.role, setup, tuple(steps))
