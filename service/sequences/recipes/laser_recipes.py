"""Laser recipes: body diagonals stepped or straight, face diagonals, and positioning along one axis."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field as Limits

from abbe.models.machine import AXES, Machine
from abbe.models.paths.lines import cycles_of, diagonal_ends, face_ends, step_diagonal, straight_line, target_shares
from abbe.service.errors import ConfigError
from abbe.service.sequences.recipes.approach import RAPID_MM_MIN, Array, as_point
from abbe.service.sequences.recipes.fields import AxisIndex, Feed, Flat, Settle, Share, TestRecipe, one_of
from abbe.service.sequences.steps import MountLaser, MoveTo, ReadLaser, Step, TestPlan, Unmount, ZeroLaser

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
        """Steps: approach, mount, zero, one reading after every move, clear away.

        Raises
        ------
        ConfigError
            A step diagonal with an overrun: its turning points have no approach direction.
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
        """Steps: approach, mount, zero, one reading after every move, clear away."""
        box = machine.stroke_mm + np.array([CLEARANCE_MM, -CLEARANCE_MM])
        start, end = face_ends(box, self.plane, self.diagonal, self.at_share)
        letters = ["p", "p", "p"]
        letters["XYZ".index(self.plane[0])] = self.diagonal[0]
        setup = {"setup_id": self.setup_id, "diagonal": "".join(letters), "face": self.plane, "steps": self.steps}
        return _laser_plan(self, "laser_diagonal", setup, straight_line(start, end, self.steps + 1, back=False))


@dataclass(frozen=True, slots=True)
class Linear(BeamTest):
    """Single-axis positioning by laser (ISO 230-2), with this number of ``positions`` out and back.

    ``at_share``: relative positions in the strokes of the two other axes, in the order X, Y, Z. ``offset_share``: largest pseudo-random
    shift of a position, as a share of the interval, to reveal periodic errors (ISO 230-2); ``seed``: of the shifts.
    """

    axis: AxisIndex
    _: KW_ONLY
    at_share: tuple[Share, Share]
    positions: Annotated[int, Limits(ge=5, le=1000)] = 25
    offset_share: Annotated[float, Limits(ge=0.0, le=0.4)] = 0.0
    seed: Annotated[int, Limits(ge=0, le=2**31)] = 1
    kind: Literal["line"] = "line"

    def plan(self, machine: Machine) -> TestPlan:
        """Steps: approach, mount, zero, one reading after every move, clear away."""
        others = [a for a in range(3) if a != self.axis]
        start = machine.stroke_mm[:, 0].copy()
        start[others] += np.array(self.at_share) * machine.length_mm[others]
        end = start.copy()
        start[self.axis], end[self.axis] = machine.stroke_mm[self.axis] + np.array([CLEARANCE_MM, -CLEARANCE_MM])
        out = straight_line(start, end, self.positions, back=False)
        if self.offset_share:
            out = start + target_shares(self.positions, self.offset_share, self.seed)[:, None] * (end - start)
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
