"""The steps of a test. A plan is a tuple of steps; one runner interprets them, one dry run checks them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from abbe.service.domain.artefact import Touched
from abbe.service.domain.machine import Point
from abbe.service.domain.run import AnySetup, BarSetup

MAX_PATH_POINTS = 8192
"""Points of the controller's path memory (docs/protocols/cnc.md, FIFO_SIZE)."""


@dataclass(frozen=True, slots=True)
class MoveTo:
    """Straight move to commanded coordinates. ``guarded``: move by a touch command if a probe is fitted; a contact then stops the axes."""

    target_mm: Point
    feed_mm_min: float
    guarded: bool = False


@dataclass(frozen=True, slots=True)
class MountBar:
    """The machine stands at the sphere's centre: a person mounts cup and bar."""

    radius_mm: float


@dataclass(frozen=True, slots=True)
class TakeBarOut:
    """A person takes the bar out before the machine leaves its sphere; the cup stays in place."""


@dataclass(frozen=True, slots=True)
class ChangeBar:
    """A person mounts another bar at the same cup; the machine stands at the start of its path."""

    radius_mm: float


@dataclass(frozen=True, slots=True)
class MountLaser:
    """The machine stands at the start of the line: a person sets up laser and mirror along ``beam`` (unit vector)."""

    beam: Point


@dataclass(frozen=True, slots=True)
class Unmount:
    """A person takes the instrument off the machine before anything moves fast again. A test that fails skips this step."""


@dataclass(frozen=True, slots=True)
class ZeroLaser:
    """The laser's displacement is zeroed here."""


@dataclass(frozen=True, slots=True)
class ReadLaser:
    """Wait ``settle_s`` of controller time after the move, then record one fresh reading. ``direction`` +1 out, -1 back."""

    direction: int
    settle_s: float = 0.3


@dataclass(frozen=True, slots=True)
class RecordPath:
    """Run a polyline at constant feed while the ball-bar streams. The machine stands at its first point.

    ``measured``: numbers of the first and last measured point; feed-in is before, feed-out after them. None: all points.
    """

    points_mm: tuple[Point, ...]
    feed_mm_min: float
    rate_hz: int
    direction: int
    measured: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True)
class FollowPath:
    """Run a polyline without recording, such as the way along the sphere to the start of the next path."""

    points_mm: tuple[Point, ...]
    feed_mm_min: float


@dataclass(frozen=True, slots=True)
class ReadBar:
    """Wait ``settle_s`` of controller time after the move, then record the mean of ``samples`` ball-bar samples taken at standstill."""

    direction: int
    settle_s: float = 0.3
    samples: int = 20
    rate_hz: int = 1000


@dataclass(frozen=True, slots=True)
class MountArtefact:
    """A person clamps an artefact in this pose (axis position of its zero; columns of ``matrix``: its axes) and fits the touch probe."""

    origin_mm: Point
    matrix: tuple[Point, Point, Point]


@dataclass(frozen=True, slots=True)
class TouchFeature(Touched):
    """Touch a hole or ball from all sides; begins and ends above it, where the stylus is clear of everything.

    ``centre_mm``: expected axis position with the tip in its centre (hole: at the depth of the touches); ``radius_mm``: expected
    distance of the tip's centre from it when it touches; ``sides``: unit vectors from the centre to the touches; ``inside``: a hole;
    ``up``: unit vector away from the artefact; ``clear_mm``: height above the centre that is clear. A touch runs from ``search_mm``
    before the expected contact to as far beyond it. ``nominal_mm``: nominal place in the artefact's axes; ``start_deg``: direction of
    the first touch; ``u_sphere_mm``: standard uncertainty of the radius of a qualification sphere; None: a feature of the artefact.
    """

    feature: str
    nominal_mm: Point
    centre_mm: Point
    radius_mm: float
    sides: tuple[Point, ...]
    inside: bool
    up: Point
    clear_mm: float
    search_mm: float
    repeats: int
    feed_mm_min: float
    touch_feed_mm_min: float
    start_deg: float
    u_sphere_mm: float | None = None

    @property
    def above_mm(self) -> Point:
        """Place above the feature."""
        return self.at(self.up, self.clear_mm)

    def at(self, side: Point, distance_mm: float) -> Point:
        """Place at a distance from the centre, rounded to the controller's 10 nm."""
        x, y, z = (round(c + distance_mm * u, 5) for c, u in zip(self.centre_mm, side, strict=True))
        return x, y, z

    def before_mm(self, side: Point) -> Point:
        """Start point of a touch of this side."""
        return self.at(side, self.radius_mm + (-self.search_mm if self.inside else self.search_mm))

    def beyond_mm(self, side: Point) -> Point:
        """Point at which the search for this side ends if the tip touches nothing."""
        return self.at(side, self.radius_mm + (self.search_mm if self.inside else -self.search_mm))

    def over_mm(self, side: Point) -> Point:
        """Place above the beginning of a touch, at the height of `above_mm`."""
        before = self.before_mm(side)
        rise = self.clear_mm - sum((b - c) * u for b, c, u in zip(before, self.centre_mm, self.up, strict=True))
        x, y, z = (round(b + rise * u, 5) for b, u in zip(before, self.up, strict=True))
        return x, y, z

    def places_mm(self) -> tuple[Point, ...]:
        """All places that the tip can come to, in order."""
        ways = [(*(() if self.inside else (self.over_mm(s),)), self.before_mm(s), self.beyond_mm(s)) for s in self.sides]
        return (self.above_mm, self.centre_mm if self.inside else self.above_mm, *(p for way in ways for p in way), self.above_mm)


def references_of(touches: Iterable[TouchFeature]) -> tuple[TouchFeature, ...]:
    """Return what is touched again in a pose: the qualification sphere, if there is one, and the first feature."""
    first = {one.qualifies: one for one in reversed(list(touches))}
    return tuple(first[kind] for kind in (True, False) if kind in first)


Step = (
    MoveTo | MountBar | TakeBarOut | ChangeBar | MountLaser | Unmount | ZeroLaser | ReadLaser | RecordPath | FollowPath | ReadBar
    | MountArtefact | TouchFeature
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class TestPlan:
    """One run: its kind, its set-up (not mounted yet), and its steps."""

    __test__ = False  # not a pytest class

    label: str
    test: str
    role: str
    setup: AnySetup = field(hash=False)
    steps: tuple[Step, ...]
    artefact: Mapping[str, Any] = field(default_factory=dict, hash=False, repr=False)
    """The known facts about the probed artefact (`abbe.service.domain.artefact.ArtefactObject`), as in the campaign's document."""

    @property
    def mounts(self) -> bool:
        """Whether the test begins a set-up; else it uses the set-up of an earlier test."""
        return any(isinstance(step, MountBar | MountLaser | MountArtefact) for step in self.steps)

    @property
    def setup_id(self) -> str:
        """Name of the set-up in the plan."""
        return self.setup.setup_id

    @property
    def bar(self) -> BarSetup:
        """The set-up of a ball-bar test; AssertionError for another test."""
        assert isinstance(self.setup, BarSetup), self.test
        return self.setup

    def in_setup(self, setup_id: str) -> TestPlan:
        """The same test in a set-up of another name, mounted alike."""
        return replace(self, setup=self.setup.named(setup_id))


@dataclass(frozen=True, slots=True)
class CampaignPlan:
    """Runs in the order in which they are measured."""

    name: str
    tests: tuple[TestPlan, ...]
