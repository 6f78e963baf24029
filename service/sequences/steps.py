"""The steps of a test. A plan is a tuple of steps; one runner interprets them, one dry run checks them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

Point = tuple[float, float, float]
MAX_PATH_POINTS = 8192
"""Points of the controller's path memory (docs/protocols/cnc.md, FIFO_SIZE)."""


@dataclass(frozen=True, slots=True)
class MoveTo:
    """Straight move to commanded coordinates."""

    target_mm: Point
    feed_mm_min: float


@dataclass(frozen=True, slots=True)
class MountBar:
    """The machine stands at the sphere's centre: a person mounts cup and bar."""

    radius_mm: float


@dataclass(frozen=True, slots=True)
class TakeBarOut:
    """A person takes the bar out before the machine leaves its sphere; the cup stays in place."""


@dataclass(frozen=True, slots=True)
class ChangeBar:
    """A person hangs another bar in at the same cup; the machine stands at the start of its path."""

    radius_mm: float


@dataclass(frozen=True, slots=True)
class MountLaser:
    """The machine stands at the start of the line: a person sets up laser and mirror along ``beam`` (unit vector)."""

    beam: Point


@dataclass(frozen=True, slots=True)
class Unmount:
    """A person takes bar and mirror away before anything moves fast again. Skipped when the test fails: a person is there anyway."""


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

    ``measured``: numbers of the first and last point that count; feed-in is before, feed-out after them. None: all points count.
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


Step = MoveTo | MountBar | TakeBarOut | ChangeBar | MountLaser | Unmount | ZeroLaser | ReadLaser | RecordPath | FollowPath | ReadBar


@dataclass(frozen=True, slots=True)
class TestPlan:
    """One run: its kind, its set-up document (docs/schemas/run.schema.json), and its steps."""

    __test__ = False  # not a pytest class

    label: str
    test: str
    role: str
    setup: dict[str, Any] = field(hash=False)
    steps: tuple[Step, ...]

    @property
    def mounts(self) -> bool:
        """Whether the test begins a set-up; else it uses that of an earlier test."""
        return any(isinstance(step, MountBar | MountLaser) for step in self.steps)


@dataclass(frozen=True, slots=True)
class CampaignPlan:
    """Runs in the order in which they are measured."""

    name: str
    tests: tuple[TestPlan, ...]
