"""Progress of long work, the path being recorded, and the state of devices: page, JSON, OPC UA and MTConnect share these records."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field

from abbe.service.domain.bounds import Number, Text, Word


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of work.

    ``done`` of ``total`` in the work's own unit (default: seconds of planned machine time); ``eta_s``: wall seconds left without waiting
    times, None without a basis for an estimate. For a measurement: its ``state`` (of `abbe.service.sequences.control`),
    ``why`` it waits, the number ``step`` of ``steps``, and the number of ``points`` read in the present test.
    """

    stage: Word = ""
    done: float = 0.0
    total: float = 0.0
    eta_s: float | None = None
    message: Text = ""
    state: Word = "running"
    why: Text = ""
    step: Number = 0
    steps: Number = 0
    points: Number = 0

    def __str__(self) -> str:
        share = f"{self.done / self.total:4.0%} " if self.total > 0.0 else ""
        return f"{share}{self.message or self.stage}" + ("" if self.eta_s is None else f", about {self.eta_s:.0f} s left")


ProgressSink = Callable[[Progress], None]


def ignore_progress(_: Progress) -> None:
    """Ignore progress: a sink for callers that do not want it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunningCheck(Progress):
    """The running check and its progress. ``prompt``: number of the request to a person, 0 for none; ``ask``: its text.

    ``state`` is the state of its job.
    """

    schedule: Word
    recipe: Word
    since_utc: datetime
    id: Word = ""
    prompt: Number = 0
    ask: Word = ""

    @property
    def percent(self) -> float | None:
        """Elapsed share of the planned time, percent; None if there is no plan."""
        return 100.0 * self.done / self.total if self.total > 0 else None


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedPath:
    """A path that is being recorded. ``number`` 0: there is no path.

    ``angle_deg``: angle about the axis of the test at equal steps along the path; it grows beyond 360° instead of wrapping.
    """

    number: Number = 0
    run: Word = ""
    test: Word = ""
    radius_mm: float = 0.0
    feed_mm_min: float = 0.0
    rate_hz: Number = 0
    duration_s: float = 0.0
    angle_deg: Annotated[tuple[float, ...], Field(max_length=1000)] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineReading:
    """The machine during a measurement, from answers that the measurement asked for. None: not known.

    ``at_ms``: when the controller answered, UTC milliseconds; ``position_mm``: position of the axes; ``feed_mm_min``: feed along the
    chord between two positions; ``air_c``: air temperature at the laser; ``laser_mm``: count of the laser at ``laser_at_ms``, valid only
    while ``beam_good``.
    """

    at_ms: float
    position_mm: tuple[float, float, float]
    feed_mm_min: float | None
    override_percent: Number | None
    door_open: bool
    air_c: float | None
    laser_at_ms: float | None
    laser_mm: float | None
    beam_good: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceStatus:
    """State of a device of the machine file, and the time of its last answer. The device is not polled between checks."""

    role: Word
    url: Text
    state: Literal["not used yet", "in use", "answered", "fault"]
    at_utc: datetime | None = None
    text: Text = ""
