"""The recipe of an artefact in one pose: every hole or ball touched from all sides, the first one again and again.

The first feature is the reference of the pose. It is touched again after every ``requalify_every`` features and at the end, to show
whether the probe or the artefact has changed meanwhile, and how the pose drifts. With a qualification sphere on the table, the stylus is
qualified there each time before the first feature is touched.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass, replace
from typing import Annotated, Literal

import numpy as np
from pydantic import Field as Limits

from abbe.models.geometry.rotation import matrix_zyx
from abbe.models.machine import Machine
from abbe.service.domain.artefact import ARTEFACT_TEST, MACHINE_PROBE, ArtefactObject, Feature, QualificationSphere
from abbe.service.domain.document import Doc
from abbe.service.domain.run import parsed_setup
from abbe.service.errors import ConfigError
from abbe.service.sequences.recipes.approach import Array, Coordinate, Feed, Name, TestRecipe, as_point, inner
from abbe.service.sequences.recipes.clearance import Balls, Boxes, check_clear, probe_parts
from abbe.service.sequences.steps import CampaignPlan, MountArtefact, MoveTo, Step, TestPlan, TouchFeature, Unmount

BALL, HOLE = "xyz", "xy"
LARGEST_TILT_DEG = 2.0
"""Largest tilt of a hole's axis against the stylus; beyond it the shaft of the stylus may touch the wall."""
Angle = Annotated[float, Limits(ge=-360.0, le=360.0)]
Millimetres = Annotated[float, Limits(gt=0.0, le=500.0)]


@dataclass(frozen=True, slots=True)
class ArtefactTest(TestRecipe):
    """The features of an artefact in one pose.

    ``artefact``: its name under ``[artefact]`` of the file; ``origin_mm``: axis position at which the stylus tip is at the artefact's
    zero; ``rotation_deg``: the artefact's turn about x, then y, then z of the machine; ``stylus_radius_mm``: qualified radius;
    ``stylus_length_mm``: length from the centre of its ball to the probe's body of ``body_radius_mm``, None: unknown, so the body is not
    checked; ``shaft_radius_mm``: None: as thick as the ball. ``depth_mm``: depth of the touches in a hole below its nominal place;
    ``clear_mm``: height above the features at which the way is free. ``turned_every``: every so many features the first touch is at 45
    degrees instead of 0, which shows the lobing; 0: never. ``sphere``: sphere on which the stylus is qualified; all ways then lie at one
    height.
    """

    artefact: Name
    origin_mm: tuple[Coordinate, Coordinate, Coordinate]
    _: KW_ONLY
    rotation_deg: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)
    stylus_radius_mm: Millimetres = 3.0
    shaft_radius_mm: Millimetres | None = None
    stylus_length_mm: Millimetres | None = None
    body_radius_mm: Millimetres = 20.0
    depth_mm: Annotated[float, Limits(ge=0.0, le=200.0)] = 6.0
    clear_mm: Millimetres = 20.0
    search_mm: Annotated[float, Limits(ge=0.1, le=5.0)] = 0.8
    repeats: Annotated[int, Limits(ge=2, le=10)] = 2
    requalify_every: Annotated[int, Limits(ge=2, le=1000)] = 10
    turned_every: Annotated[int, Limits(ge=0, le=1000)] = 3
    feed_mm_min: Feed = 3000.0
    touch_feed_mm_min: Feed = 100.0
    sphere: QualificationSphere | None = None
    kind: Literal["artefact"] = "artefact"
    plate: ArtefactObject | None = inner(None)  # noqa: RUF009 - a field, not a default

    def matrix(self) -> Array:
        """Columns: the artefact's axes in machine axes."""
        return matrix_zyx(self.rotation_deg)

    def plan(self, machine: Machine) -> TestPlan:
        """Return the test with its steps: up, mount, touch every feature and the first one again and again, clear away.

        Raises
        ------
        ConfigError
            The recipe does not describe the artefact, or a feature cannot be touched.
        """
        if self.plate is None:
            raise ConfigError(f"test {self.label}: the recipe has no artefact {self.artefact!r}", f"add a table [artefact.{self.artefact}]")
        touches = [self._touch(k, f) for k, f in enumerate(self.plate.features)]
        matrix, order = self.matrix(), list(self._order(touches))
        aside = self._aside(order, machine)
        self._check_clear(self.plate, order, aside)
        steps: list[Step] = [MoveTo(aside, self.feed_mm_min, guarded=True)]
        steps += [MountArtefact(self.origin_mm, (_vector(matrix[0]), _vector(matrix[1]), _vector(matrix[2]))), *order]
        if self.unmount:
            steps.append(Unmount())
        setup: Doc = {
            "setup_id": self.setup_id, "artefact": self.artefact, "source": MACHINE_PROBE,
            "tool_mm": [float(v) for v in machine.tool_mm], "tool_radius_mm": self.stylus_radius_mm,
            "pose": {"origin_mm": list(self.origin_mm), "matrix": matrix.tolist()},
        }  # fmt: skip
        known = {self.artefact: self.plate.model_dump(by_alias=True, exclude_none=True)}
        return TestPlan(self.label, ARTEFACT_TEST, self.role, parsed_setup(ARTEFACT_TEST, setup), tuple(steps), known)

    def _approach(self, feature: Feature, *, inside: bool) -> Array:
        """Return the direction that the stylus comes from, a machine axis. Raises ConfigError for a tilted hole."""
        out = self.matrix()[:, 2]
        axis = int(np.argmax(np.abs(out)))
        along: Array = np.sign(out[axis]) * np.eye(3)[axis]
        tilt = float(np.degrees(np.arccos(min(float(out @ along), 1.0))))
        thin = self.shaft_radius_mm is None or self.depth_mm * np.tan(np.radians(tilt)) <= self.stylus_radius_mm - self.shaft_radius_mm
        if inside and (tilt > LARGEST_TILT_DEG or not thin):
            raise ConfigError(
                f"artefact {self.artefact}, feature {feature.id}: its hole is tilted by {tilt:.0f} degrees against the stylus",
                "lay the plate flat or upright; balls may be tilted",
            )
        return along

    def _check_clear(self, plate: ArtefactObject, order: list[TouchFeature], start_mm: tuple[float, float, float]) -> None:
        """Refuse ways on which the probe meets a ball, an obstacle or the plate itself. Raises ConfigError."""
        there = {one.feature: one for one in order if not one.inside}
        centres, radii = np.array([b.centre_mm for b in there.values()]).reshape(-1, 3), [b.radius_mm for b in there.values()]
        balls = Balls(tuple(there), centres, np.array(radii) - self.stylus_radius_mm)
        parts = probe_parts(self.stylus_radius_mm, self.shaft_radius_mm, self.stylus_length_mm, self.body_radius_mm)
        solids = (balls, Boxes.of(plate.obstacles, self.origin_mm, self.matrix()))
        check_clear(self.artefact, order, start_mm, parts, solids, self.search_mm)
        again = order[: 1 if self.sphere is None else 2]
        for one in dict.fromkeys(order):  # after a pause at any feature the first ones are touched again
            check_clear(self.artefact, (*again, one), one.above_mm, parts, solids, self.search_mm)
        if self.shaft_radius_mm is not None and self.shaft_radius_mm > self.stylus_radius_mm:
            raise ConfigError(
                f"artefact {self.artefact}: the shaft of the stylus (radius {self.shaft_radius_mm:g} mm) is thicker than its ball "
                f"({self.stylus_radius_mm:g} mm), so the shaft touches first",
                "correct shaft_radius_mm or stylus_radius_mm",
            )
        deepest = self.depth_mm + self.search_mm
        if len(there) < len({one.feature for one in order}) and self.stylus_length_mm is not None and self.stylus_length_mm < deepest:
            raise ConfigError(
                f"artefact {self.artefact}: the body of the probe would reach the plate: the stylus is {self.stylus_length_mm:g} mm long, "
                f"and a hole is touched {self.depth_mm:g} mm deep",
                "use a longer stylus or a smaller depth_mm",
            )

    def _order(self, touches: list[TouchFeature]) -> Iterator[TouchFeature]:
        """Yield the touches of the pose. With a qualification sphere all ways lie at one height, that of the highest clear place."""
        again = touches[:1]
        if self.sphere is not None:
            again = [self._qualification(self.sphere, touches[0]), touches[0]]
            up = np.array(touches[0].up)
            top = max(float(np.array(one.above_mm) @ up) for one in (*touches, *again))
            touches, again = ([replace(t, clear_mm=top - float(np.array(t.centre_mm) @ up)) for t in some] for some in (touches, again))
            yield again[0]
        for k, one in enumerate(touches):
            if k and k % self.requalify_every == 0:
                yield from again
            yield one
        yield from again

    def _qualification(self, sphere: QualificationSphere, like: TouchFeature) -> TouchFeature:
        """Return the touches of the qualification sphere. Raises ConfigError if a feature has its name."""
        if self.plate is not None and sphere.id in {f.id for f in self.plate.features}:
            raise ConfigError(f"artefact {self.artefact}: sphere and feature are both called {sphere.id!r}", "give the sphere another id")
        reach = sphere.radius_mm + self.stylus_radius_mm
        return replace(
            like, feature=sphere.id, nominal_mm=(0.0, 0.0, 0.0), centre_mm=as_point(np.array(sphere.centre_mm)), radius_mm=reach,
            sides=_sides(np.array(like.up), 0.0, ball=True), inside=False, clear_mm=self.clear_mm + reach, start_deg=0.0,
            u_sphere_mm=sphere.U_mm / sphere.k,
        )  # fmt: skip

    def _aside(self, touches: list[TouchFeature], machine: Machine) -> tuple[float, float, float]:
        """Return where the machine waits for the person: above the first feature, as far from the artefact as the strokes allow."""
        up, place = np.array(touches[0].up), np.array(touches[0].above_mm)
        ends = np.where(up > 0.5, machine.stroke_mm[:, 1], np.where(up < -0.5, machine.stroke_mm[:, 0], place))
        return as_point(ends)

    def _touch(self, k: int, feature: Feature) -> TouchFeature:
        if feature.sensed not in (BALL, HOLE) or feature.normal is not None or feature.radius_mm is None:
            raise ConfigError(
                f"artefact {self.artefact}, feature {feature.id}: only holes (sensed = 'xy') and balls ('xyz') with radius_mm are touched",
                "give radius_mm, or find its point otherwise and use `abbe import`",
            )
        inside, matrix = feature.sensed == HOLE, self.matrix()
        radius = feature.radius_mm - self.stylus_radius_mm if inside else feature.radius_mm + self.stylus_radius_mm
        if radius <= 2.0 * self.search_mm:
            raise ConfigError(
                f"artefact {self.artefact}, feature {feature.id}: no room for a stylus of {self.stylus_radius_mm:g} mm radius in this hole",
                "use a smaller stylus or a smaller search_mm",
            )
        up = self._approach(feature, inside=inside)
        start = 45.0 if self.turned_every and k % self.turned_every == self.turned_every - 1 else 0.0
        centre = np.array(self.origin_mm) + matrix @ np.array(feature.nominal_mm) - (self.depth_mm * up if inside else 0.0)
        clear = self.clear_mm + (self.depth_mm if inside else feature.radius_mm + self.stylus_radius_mm)
        return TouchFeature(
            feature.id, feature.nominal_mm, as_point(centre), radius, _sides(up, start, ball=not inside), inside, _vector(up), clear,
            self.search_mm, self.repeats, self.feed_mm_min, self.touch_feed_mm_min, start,
        )  # fmt: skip


def verifying_poses(machine: Machine, name: str, recipes: tuple[object, ...]) -> CampaignPlan:
    """Return the poses of a recipe as a verification: runs that no solution uses. Raises ConfigError for other tests or no test."""
    poses = [r for r in recipes if isinstance(r, ArtefactTest)]
    if not poses or len(poses) < len(recipes):
        raise ConfigError(f"recipe {name}: a verification by poses allows only tests of kind 'artefact'", "leave the other tests out")
    return CampaignPlan(name, tuple(replace(r, role="holdout").plan(machine) for r in poses))


def _sides(up: Array, start_deg: float, *, ball: bool) -> tuple[tuple[float, float, float], ...]:
    """Return unit vectors from the centre to the touches: two opposite pairs about ``up`` from ``start_deg`` on; a ball's top first."""
    first = np.eye(3)[int(np.argmin(np.abs(up)))]
    first = first - (first @ up) * up
    first /= np.linalg.norm(first)
    second = np.cross(up, first)
    angles = np.deg2rad(start_deg + np.array([0.0, 180.0, 90.0, 270.0]))
    around = [np.cos(a) * first + np.sin(a) * second for a in angles]
    return tuple(_vector(side) for side in ([up, *around] if ball else around))


def _vector(v: Array) -> tuple[float, float, float]:
    x, y, z = (np.round(v, 12) + 0.0).tolist()
    return x, y, z
