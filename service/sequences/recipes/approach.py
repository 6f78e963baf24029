"""Parts that all recipes share: fields with their limits, the controller's grid, approach positions, and the ball-bar's way to a path.

Programs and files (`abbe.service.sequences.recipes.recipe_file`) make the same recipe objects. The limits in the annotations apply to
files; programs may exceed them, as tests do.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import KW_ONLY, Field, dataclass, field, fields
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BeforeValidator, ConfigDict
from pydantic import Field as Limits

from abbe.models.machine import AXES, Machine
from abbe.models.paths import way_on_sphere
from abbe.service.domain.machine import Point
from abbe.service.domain.run import BarSetup
from abbe.service.sequences.steps import ChangeBar, FollowPath, MountBar, MoveTo, Step, TakeBarOut


def one_of(*choices: str) -> AfterValidator:
    """Return a validator that accepts only these values."""

    def check(value: str) -> str:
        if value not in choices:
            raise ValueError(f"expected {', '.join(map(repr, choices[:-1]))} or {choices[-1]!r}, got {value!r}")
        return value

    return AfterValidator(check)


def _axis(letter: object) -> int:
    if not isinstance(letter, str) or letter not in tuple(AXES):
        raise ValueError(f"expected 'X', 'Y' or 'Z', got {letter!r}")
    return AXES.index(letter)


def _rate(rate_hz: int) -> int:
    if 1000 % rate_hz:
        raise ValueError(f"expected a rate that divides 1000 Hz (1000, 500, 250, 200, 125, 100, 50 ...), got {rate_hz}")
    return rate_hz


Name = Annotated[str, Limits(min_length=1, max_length=80, pattern=r"^[^\s/\\](?:[^\n\r/\\]*[^\s/\\])?$")]
Feed = Annotated[float, Limits(gt=0.0, le=100_000.0)]
Coordinate = Annotated[float, Limits(ge=-1e5, le=1e5)]
Share = Annotated[float, Limits(ge=0.0, le=1.0)]
Settle = Annotated[float, Limits(ge=0.0, le=60.0)]
AxisIndex = Annotated[int, BeforeValidator(_axis)]
"""Number of an axis, 0 to 2; a file gives the axis letter instead."""
Rate = Annotated[int, Limits(ge=1, le=1000), AfterValidator(_rate)]
Flat = Annotated[str, one_of("XY", "YZ", "ZX")]
IN_FILE = "in_file"


def inner(default: Any) -> Any:
    """Return a field that no file sets: its value follows from neighbouring tests, or belongs to a built-in campaign."""
    return field(default=default, metadata={IN_FILE: False})


@dataclass(frozen=True, slots=True)
class TestRecipe:
    """A test: its label, its set-up, and its role (identify or holdout).

    ``mount`` and ``unmount`` are false where consecutive tests share a set-up: the second does not mount, the first leaves the bar or the
    mirror.
    """

    __test__ = False  # not a pytest class
    __pydantic_config__ = ConfigDict(extra="forbid", allow_inf_nan=False)

    label: Name
    setup_id: Annotated[Name, Limits(alias="setup")]
    role: Annotated[str, one_of("identify", "holdout")]
    _: KW_ONLY
    mount: bool = inner(True)
    unmount: bool = inner(True)


def file_fields(kind: type[TestRecipe]) -> dict[str, Field[Any]]:
    """Return the fields of a recipe that a file sets, by key."""
    return {"setup" if f.name == "setup_id" else f.name: f for f in fields(kind) if f.metadata.get(IN_FILE, True)}


def file_table(recipe: TestRecipe) -> dict[str, Any]:
    """Return a recipe as a table of a recipe file, without empty values that equal the default."""
    found = {key: (getattr(recipe, f.name), f.default) for key, f in file_fields(type(recipe)).items()}
    kind = {"kind": found.pop("kind")[0]}
    shown = {key: value for key, (value, default) in found.items() if value or value != default}
    return kind | shown | ({"axis": AXES[shown["axis"]]} if "axis" in shown else {})


Array = NDArray[np.float64]
RAPID_MM_MIN = 6000.0
BAR_APPROACH_MM = 0.5
"""Length of the approach with the bar mounted: far more than any lost motion, and within the bar's stroke of 1 mm either way."""
LINK_CHORD_MM = 2.0
"""Chord length of the way on the sphere between two paths: at a radius of 50 mm a chord runs 10 um inside the sphere."""
SAME_PLACE_MM = 0.01
NEAR_POLE_MM = 2.0
"""A path that starts this near the pole needs no way along the sphere: the machine moves from the centre up to the pole."""
LOW_SHARE = 0.4
"""Lowest allowed depth below the cup's centre, as a share of the bar: deeper, the spindle hits the cup's support (the partial arc of 220
degrees of ISO 230-4 with its feed-in stays above)."""


@dataclass(frozen=True, slots=True)
class Cup:
    """A ball-bar's sphere: centre, radius, and the unit vector to its pole, where the spindle is."""

    centre: Array
    radius_mm: float
    up: Array

    @property
    def pole(self) -> Array:
        """Pole of the sphere, mm."""
        return np.asarray(self.centre + self.radius_mm * self.up)

    def lowest(self, points: Iterable[Point]) -> float:
        """Return the height of the lowest point above the equator, as a share of the radius; negative: below."""
        return float(((np.array(list(points)) - self.centre) @ self.up).min()) / self.radius_mm


@dataclass(frozen=True, slots=True)
class CupTest(TestRecipe):
    """A ball-bar test: position of its cup, and its bar.

    ``opens``: the pole is on the positive (1) or negative (-1) side of ``axis``, where the spindle is.
    ``u_length_mm``: standard uncertainty of the bar's length on its certificate; not ``length_calibrated``: the length was never measured.
    ``change_bar``: the previous test had another radius; the cup stays, a person takes the bar out before the machine moves and mounts the
    other one at the start of its path. ``link_mm``: end of the previous test, if this one starts elsewhere on the same sphere.
    """

    centre_mm: tuple[Coordinate, Coordinate, Coordinate]
    radius_mm: Annotated[float, Limits(ge=0.1, le=2000.0)]
    _: KW_ONLY
    axis: AxisIndex = 2
    opens: Literal[1, -1] = 1
    direction: Literal[1, -1] = 1
    feed_mm_min: Feed = 2000.0
    rate_hz: Rate = 100
    length_calibrated: bool = True
    u_length_mm: Annotated[float, Limits(ge=0.0, le=1.0)] = 0.002
    change_bar: bool = inner(False)
    link_mm: Point | None = inner(None)  # noqa: RUF009 - a field, not a default


def as_point(v: Array) -> Point:
    """Return a position, rounded to the controller's 10 nm grid."""
    return as_points(v[np.newaxis])[0]


def as_points(rows: Array) -> tuple[Point, ...]:
    """Return each row as a point, rounded to the controller's 10 nm grid."""
    return tuple((round(x, 5), round(y, 5), round(z, 5)) for x, y, z in rows.tolist())


def before(path: tuple[Point, ...], machine: Machine) -> Point:
    """Return the approach position: `BAR_APPROACH_MM` from the path's start, against the first motion of each axis, inside the strokes."""
    points = np.array(path)
    steps = np.diff(points, axis=0)
    first = np.array([next((np.sign(s) for s in steps[:, a] if s), 0.0) for a in range(3)])
    return as_point(np.clip(points[0] - BAR_APPROACH_MM * first, machine.stroke_mm[:, 0], machine.stroke_mm[:, 1]))


def pole_of(recipe: CupTest) -> tuple[Point, Array]:
    """Return the pole of a test's hemisphere, where the spindle is, and the unit vector from the centre to it."""
    up = np.zeros(3)
    up[recipe.axis] = float(recipe.opens)
    return as_point(np.array(recipe.centre_mm) + recipe.radius_mm * up), up


def over_pole(cup: Cup, target_mm: Point, feed_mm_min: float) -> list[Step]:
    """Return the steps to a point of the sphere from the centre, or from above it on the cup's axis: to the pole, then along the sphere.

    A straight move from the centre to a point below the equator would pass through the cup.
    """
    pole = as_point(cup.pole)
    if math.dist(pole, target_mm) < NEAR_POLE_MM:
        return [MoveTo(pole, RAPID_MM_MIN)]
    return [MoveTo(pole, RAPID_MM_MIN), *along_sphere(cup, pole, target_mm, feed_mm_min)]


def along_sphere(cup: Cup, start_mm: Point, end_mm: Point, feed_mm_min: float) -> list[Step]:
    """Return the steps along a sphere from one of its points to another; none if they coincide."""
    if math.dist(start_mm, end_mm) <= SAME_PLACE_MM:
        return []
    way = way_on_sphere(cup.centre, np.array(start_mm), np.array(end_mm), cup.up, LINK_CHORD_MM)
    return [FollowPath(as_points(way), feed_mm_min)]


def cup_of(setup: BarSetup) -> Cup:
    """Return the sphere of a planned ball-bar test, and the direction in which its cup opens."""
    up = np.zeros(3)
    up[AXES.index(setup.axis)] = float(setup.opens or 1)
    return Cup(setup.centre_mm, setup.radius_mm, up)


def to_path(recipe: CupTest, path: tuple[Point, ...], machine: Machine) -> list[Step]:
    """Return the steps to the first point of a ball-bar path: mount, change the bar or move along the sphere, and approach.

    No move passes the cup straight: from the centre, and after a change of the bar, the machine moves over the pole and along the sphere.
    ``link_mm`` lies on this sphere or, with ``change_bar``, on the previous bar's sphere; a straight move from there would cut the sphere.
    """
    up = pole_of(recipe)[1]
    centre, feed = np.array(recipe.centre_mm), recipe.feed_mm_min
    cup = Cup(centre, recipe.radius_mm, up)
    start = before(path, machine)
    steps: list[Step] = []
    if recipe.mount:
        steps += [MoveTo(recipe.centre_mm, RAPID_MM_MIN), MountBar(recipe.radius_mm), *over_pole(cup, path[0], feed)]
    elif recipe.change_bar:
        steps.append(TakeBarOut())
        if recipe.link_mm is not None:
            old = Cup(centre, math.dist(recipe.link_mm, recipe.centre_mm), up)
            steps += along_sphere(old, recipe.link_mm, as_point(old.pole), RAPID_MM_MIN)  # the bar is out
        steps += over_pole(cup, path[0], RAPID_MM_MIN)
        steps += [MoveTo(start, feed), ChangeBar(recipe.radius_mm)]
    elif recipe.link_mm is not None:
        steps += along_sphere(cup, recipe.link_mm, path[0], feed)
    if not recipe.change_bar or recipe.mount:
        steps.append(MoveTo(start, feed))
    steps.append(MoveTo(path[0], feed))
    return steps
