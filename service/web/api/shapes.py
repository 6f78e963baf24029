"""What the interface answers about machines, measurements and the plant. Times are UTC, ISO 8601; units stand in the names."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from abbe.service.domain.device_status import DeviceStatus
from abbe.service.runs.machine_object import MachineObject
from abbe.service.web.schemas import Verification, Verified


class Answer(BaseModel):
    """Base of all answers."""

    model_config = ConfigDict(extra="ignore", frozen=True)


NextCursor = Annotated[int | None, Field(description="Give it as `cursor` for the next page; null: this is the last one.")]


class Machine(Answer):
    """A machine as it was described at some time; another description is another number."""

    number: int
    name: str
    created_utc: str
    description: MachineObject | None = Field(description="null: it was stored in another form")


class Machines(Answer):
    """Machines, newest description first."""

    machines: list[Machine]
    next_cursor: NextCursor


class Devices(Answer):
    """Devices of this service's machine. They are not asked for this answer."""

    machine: str
    devices: list[DeviceStatus]


class Recipe(Answer):
    """A shipped recipe that a schedule can name."""

    name: str
    about: str


class Recipes(Answer):
    """Shipped recipes."""

    recipes: list[Recipe]


class Campaign(Answer):
    """Runs that belong together."""

    number: int
    name: str
    machine: str
    created_utc: str


class Campaigns(Answer):
    """Campaigns, newest first."""

    campaigns: list[Campaign]
    next_cursor: NextCursor


class Run(Answer):
    """One measured sequence. ``status`` is as people are told: a run whose process died is incomplete."""

    number: int
    campaign: str
    machine: str
    run_id: str
    test: str
    role: str
    status: str
    reason: str
    started_utc: str
    ended_utc: str | None


class Runs(Answer):
    """Runs, newest first."""

    runs: list[Run]
    next_cursor: NextCursor


class CampaignDetail(Campaign):
    """A campaign with its runs, in the order of measuring, and what was made of them."""

    runs: list[Run]
    solutions: list[int]
    discoveries: list[int]


class Channel(Answer):
    """What a run holds of one device. ``codec``: how it is packed; ``bar/1`` also has the binary form."""

    channel: str
    codec: str
    chunks: int
    samples: int


class RunDetail(Run):
    """A run with what it holds."""

    channels: list[Channel]
    gaps: int = Field(description="Stretches of samples that are known to be missing.")


class BarSamples(Answer):
    """Ball-bar samples as they arrived."""

    seq: list[int]
    device_us: list[int]
    reading_nm: list[int]
    status: list[int]


class Samples(Answer):
    """A stretch of one channel as it arrived: ball-bar samples in columns, or records of another device."""

    run: int
    channel: str
    first: int
    count: int
    total: int
    bar: BarSamples | None = None
    records: list[dict[str, float | int | str | bool | list[float | None] | None]] | None = None


class Columns(Answer):
    """A stretch of the evaluated columns of a run (``abbe-run/1``): every reading with its place. null: the column is sealed."""

    run: int
    first: int
    count: int
    total: int
    columns: dict[str, list[float | None] | None]


class Figure(Answer):
    """Trend of one figure. Uncertainties have k = 2; what is not known is null, with its reason."""

    figure: str
    checks: int
    latest: float
    expanded_uncertainty: float
    limit: float | None
    state: str
    direction: int
    since_utc: datetime | None
    found_utc: datetime | None
    change_per_day: float | None
    change_per_day_u: float | None
    days_until_limit: float | None
    days_until_limit_95: tuple[float | None, float | None] | None
    reason: str
    cusum_high: float | None
    cusum_low: float | None
    ewma: float | None
    ewma_limit: float | None


class Trends(Answer):
    """Trends of a machine's figures over its checks."""

    machine: str
    figures: list[Figure]
    verified: Verified = Field(default_factory=lambda: Verified(changes=[]))


class Slot(Answer):
    """One time at which a schedule was due, and what became of it."""

    slot_utc: str
    state: str
    reason: str
    finished_utc: str | None


class ScheduleState(Answer):
    """One line of the timetable. ``next_due_utc`` null: its expression never matches again."""

    name: str
    recipe: str
    cron: str
    every_h: float
    timezone: str
    grace_s: float
    catch_up: Literal["skip", "once"]
    in_words: str
    next_due_utc: datetime | None
    latest: list[Slot]


class Schedules(Answer):
    """The timetable of this service's machine."""

    machine: str
    schedules: list[ScheduleState]


class VerificationPage(Answer):
    """Checks of all machines, newest first."""

    verifications: list[Verification]
    next_cursor: NextCursor


class ErrorCode(Answer):
    """One code of the catalogue."""

    code: str
    name: str
    meaning: str
    status: int | None


class ErrorCodes(Answer):
    """All codes."""

    errors: list[ErrorCode]
