"""Laser recipes: body diagonals stepped or straight, face diagonals, and positioning along one axis."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from abbe.models.machine import AXES, Machine
from abbe.models.paths.lines import cycles_of, diagonal_ends, face_ends, step_diagonal, straight_line, target_shares
from abbe.service.errors import ConfigError
from abbe.service.sequences.recipes.approach import RAPID_MM_MIN, Array, as_point
from abbe.service.sequences.steps import MountLaser, MoveTo, ReadLaser, Step, TestPlan, Unmount, ZeroLaser

APPROACH_MM = 1.0
CLEARANCE_MM = 10.0
"""Laser lines keep this distance from the ends of the strokes, so that the approach and an overrun stay inside them."""


@dataclass(frozen=True, slots=True)
class Diagonal:
    """Body diagonal by laser: sequential single-axis ``steps`` (Wang), or plain positions when ``order`` is empty; out and back.

    ``cycles``: out and back so many times, in one run. ``overrun_mm`` (plain positions only): the machine turns so far beyond both ends, so
    that every position is approached in the direction of its leg; the turning points are read as well.
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
    cycles: int = 1
    overrun_mm: float = 0.0

    def plan(self, machine: Machine) -> TestPlan:
        """Steps: approach, mount, zero, one reading after every move, clear away.

        Raises
        ------
        ConfigError
            A step diagonal with an overrun: its turning points have no side to be approached from.
        """
        if self.order and self.overrun_mm:
            raise ConfigError(f"test {self.label}: a step diagonal has no overrun", "leave overrun_mm out, or the order")
        box = machine.stroke_mm + np.array([CLEARANCE_MM, -CLEARANCE_MM])
        start, end = diagonal_ends(box, self.diagonal)
        if self.order:
            out = step_diagonal(start, end, self.steps, self.order, back=False)
        else:
            out = straight_line(start, end, self.steps + 1, back=False)
        setup: dict[str, Any] = {"setup_id": self.setup_id, "diagonal": self.diagonal, "steps": self.steps}
        if self.order:
            setup["order"] = self.order
        return _laser_plan(self, "laser_diagonal", setup, out)


@dataclass(frozen=True, slots=True)
class FaceDiagonal:
    """Diagonal of a plane of two axes by laser (ISO 230-6 has six of them: two in each plane), the third axis at ``at`` of its stroke.

    ``diagonal``: ``pp`` both axes of the plane grow, ``np`` the first falls. As a run it is a ``laser_diagonal`` that does not move the
    third axis: its letter in ``diagonal`` is p, and ``face`` names the plane.
    """

    label: str
    setup_id: str
    role: str
    plane: str
    diagonal: str
    steps: int = 12
    at: float = 0.5
    feed_mm_min: float = RAPID_MM_MIN
    settle_s: float = 0.3
    mount: bool = True
    unmount: bool = True
    cycles: int = 1
    overrun_mm: float = 0.0

    def plan(self, machine: Machine) -> TestPlan:
        """Steps: approach, mount, zero, one reading after every move, clear away."""
        box = machine.stroke_mm + np.array([CLEARANCE_MM, -CLEARANCE_MM])
        start, end = face_ends(box, self.plane, self.diagonal, self.at)
        letters = ["p", "p", "p"]
        letters["XYZ".index(self.plane[0])] = self.diagonal[0]
        setup = {"setup_id": self.setup_id, "diagonal": "".join(letters), "face": self.plane, "steps": self.steps}
        return _laser_plan(self, "laser_diagonal", setup, straight_line(start, end, self.steps + 1, back=False))


@dataclass(frozen=True, slots=True)
class Linear:
    """Single-axis positioning by laser (ISO 230-2 line), ``n`` positions out and back, at relative place ``at`` of the other strokes.

    ``at``: one place for both other axes, or one for each in the order X, Y, Z. ``cycles``: out and back so many times (ISO 230-2: five).
    ``overrun_mm``: the machine turns so far beyond both ends, so that every position is approached in the direction of its leg; the turning
    points are read as well. ``offset_share``: each position is moved by a pseudo-random part of the interval, at most by this share of it,
    so that errors with a period do not hide (ISO 230-2); ``seed`` says which.
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
    cycles: int = 1
    overrun_mm: float = 0.0
    offset_share: float = 0.0
    seed: int = 1

    def plan(self, machine: Machine) -> TestPlan:
        """Steps: approach, mount, zero, one reading after every move, clear away."""
        others = [a for a in range(3) if a != self.axis]
        start = machine.stroke_mm[:, 0].copy()
        start[others] += np.array(self.at) * machine.length_mm[others]
        end = start.copy()
        start[self.axis], end[self.axis] = machine.stroke_mm[self.axis] + np.array([CLEARANCE_MM, -CLEARANCE_MM])
        out = straight_line(start, end, self.n, back=False)
        if self.offset_share:
            out = start + target_shares(self.n, self.offset_share, self.seed)[:, None] * (end - start)
        return _laser_plan(self, "laser_linear", {"setup_id": self.setup_id, "axis": AXES[self.axis]}, out)


LaserRecipe = Diagonal | FaceDiagonal | Linear


def _laser_plan(recipe: LaserRecipe, test: str, setup: dict[str, Any], out: Array) -> TestPlan:
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
    if test == "laser_diagonal":
        setup["increment_mm"] = [float(v) for v in (out[-1] - out[0]) / setup["steps"]]  # overruns are no part of a step
    setup |= {"start_mm": list(path[0]), "end_mm": list(path[far]), "nominal_beam": [float(v) for v in beam]}
    if recipe.cycles > 1 or recipe.overrun_mm:
        setup |= {"cycles": recipe.cycles, "overrun_mm": recipe.overrun_mm}
    return TestPlan(recipe.label, test, recipe.role, setup, tuple(steps))
