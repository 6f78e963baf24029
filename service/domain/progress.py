"""Progress of long work, jobs and their ends, the path being recorded, and the state of devices: page, JSON, OPC UA and MTConnect share
these records.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field

from abbe.service.domain.document import Number, Text, Word


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


JobKind = Literal["check", "campaign", "investigation", "push", "rollback"]


@dataclass(frozen=True, slots=True, kw_only=True)
class JobState:
    """A job since the service started: a check, a full campaign, work on an alarm, or a rollback ordered by a person.

    ``state``: running, asking, pausing, paused, …; at the end ``interrupted``, or ``done: WORD``. The word is the verdict of a check;
    ``kept``, ``rolled back``, ``refused``, ``stopped``, ``failed`` or ``open`` for a push; ``proposed``, ``ended``, ``failed`` or
    ``stopped`` for a campaign or an investigation. A rollback is a push of the previous table: ``kept`` means that this table is in
    force again. While it is ``asking``, a person has to do what ``ask`` says and confirm the number ``prompt``. ``who``:
    empty if no person ordered it. ``alarm``: the alarm for which it works; None: it works for no alarm. ``solution``, ``proposal``: results
    of a campaign in the store.
    """

    id: Word
    kind: JobKind
    recipe: Word
    schedule: Word
    who: Word
    state: Word
    text: Text
    begun_utc: datetime
    ended_utc: datetime | None = None
    verification: Number | None = None
    alarm: Number | None = None
    prompt: Number = 0
    ask: Word = ""
    solution: Number | None = None
    proposal: Number | None = None


@dataclass(frozen=True, slots=True)
class JobOutcome:
    """End of a job: a word, a sentence, and the job's results in the store.

    ``word`` of a push or rollback: ``kept``: the new table is in force and verified; ``rolled back``: the old table is in force again;
    ``refused``, ``failed``, ``stopped`` (by a person): the new table was never in force; ``open``: it may be in force, unverified. Of a
    campaign: ``proposed``, ``ended`` (no proposal can be approved), ``failed``, ``stopped``. ``waits``: another process has the machine,
    nothing was begun.
    """

    word: str
    text: str
    solution: int | None = None
    proposal: int | None = None
