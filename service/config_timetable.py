"""The timetable in the machine file: schedules, maintenance windows, staffed hours."""

from __future__ import annotations

from datetime import UTC, datetime, time
from typing import Annotated, Literal, Self
from zoneinfo import ZoneInfo

from cronsim import CronSim, CronSimError
from pydantic import AfterValidator, AwareDatetime, BaseModel, ConfigDict, Field, model_validator

Day = Literal["mon", "tue", "wed", "thu", "fri", "sat", "sun"]


class Section(BaseModel):
    """A table of the machine file: no unknown key, no NaN, no change afterwards."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


def _cron(text: str | None) -> str | None:
    try:
        if text is not None:
            CronSim(text, datetime(2026, 1, 1, tzinfo=UTC))
    except CronSimError as err:
        raise ValueError(f"expected a cron expression (minute hour day month weekday), got {text!r}: {err}") from None
    return text


def _timezone(text: str) -> str:
    try:
        ZoneInfo(text)
    except (KeyError, ValueError, OSError):
        raise ValueError(f"expected an IANA time zone such as Europe/Berlin or UTC, got {text!r}") from None
    return text


Cron = Annotated[str | None, AfterValidator(_cron)]
Zone = Annotated[str, AfterValidator(_timezone)]


class NeedsEntry(Section):
    """What has to be so before a check starts; it waits for it as long as the grace."""

    idle: bool = Field(default=False, description="controller ready, nothing moves, no NC program, spindle off")
    warm_min: float = Field(
        default=0.0,
        ge=0.0,
        le=50.0,
        description="so many of the last 60 minutes the spindle turned or an axis moved, as the service saw it",
    )
    air: bool = Field(default=False, description="air temperature (of the laser) inside [limits] temperature_c")
    operator: Literal["any", "present", "absent"] = Field(default="any", description="by [[staffed]]; absent: the door is shut, too")


class ScheduleEntry(Section):
    """One line of the timetable: by cron expression or by interval."""

    name: str = Field(min_length=1, max_length=200)
    cron: Cron = Field(default=None, description="minute hour day month weekday, e.g. 0 6 * * 1")
    every_h: float | None = Field(default=None, ge=1 / 60, le=8784.0, description="instead of cron: interval in hours")
    first: AwareDatetime | None = Field(
        default=None, description="a moment from which every_h is counted, e.g. 2026-11-02T06:00:00+01:00; absent: 2026-01-01T00:00:00Z"
    )
    timezone: Zone = Field(default="UTC", description="IANA name, e.g. Europe/Berlin")
    recipe: str = Field(default="quick-check", min_length=1, description="what to measure")
    grace_s: float = Field(
        default=300.0,
        ge=1.0,
        le=86_400.0,
        description="a slot may start so late; found later, or kept from starting for longer, it is missed",
    )
    catch_up: Literal["skip", "once"] = Field(
        default="skip", description="missed slots: skip: recorded, the machine is not moved; once: recorded, and one run for all of them"
    )
    needs: NeedsEntry = NeedsEntry()
    on_alarm: Literal["none", "propose"] = Field(
        default="none",
        description="propose: when a check raises an alarm, [alarm] campaign is measured, solved and searched by itself, and tables are "
        "proposed, which wait for approval",
    )

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if (self.cron is None) == (self.every_h is None):
            raise ValueError(f"expected either cron = ... or every_h = ..., got {'neither' if self.cron is None else 'both'}")
        if self.first is not None and self.every_h is None:
            raise ValueError("expected every_h = ... beside first = ...: a cron expression is not counted from anywhere")
        return self


class AlarmSection(Section):
    """When scheduled checks raise an alarm beside their limits, and what may follow by itself."""

    warn_days: float = Field(
        default=14.0, ge=0.0, le=3650.0, description="alarm when a limit may be reached within so many days (lower end, 95 %); 0: never"
    )
    campaign: str = Field(
        default="identification", min_length=1, description="what on_alarm measures: identification, or a recipe FILE.toml beside this file"
    )
    push: Literal["never", "approved"] = Field(
        default="never",
        description="approved: a proposal that a person has approved is pushed by the service when the machine is idle, and verified",
    )
    watch_table: bool = Field(
        default=True, description="look every 10 s whether somebody else put another compensation table into force, and raise an alarm"
    )


class WindowEntry(Section):
    """A window in time: so many hours from each time of a cron expression, or from start to end on some days of the week."""

    name: str = Field(min_length=1, max_length=200)
    timezone: Zone = Field(default="UTC", description="IANA name, e.g. Europe/Berlin")
    cron: Cron = Field(default=None, description="when it begins, e.g. 0 14 * * 5")
    hours: float | None = Field(default=None, gt=0.0, le=744.0, description="how long it lasts, with cron")
    days: list[Day] | None = Field(default=None, min_length=1, description='instead of cron: days on which it begins, e.g. ["sat", "sun"]')
    start: time | None = Field(default=None, description="wall time, with days, e.g. 22:00:00")
    end: time | None = Field(default=None, description="wall time; not later than start: on the day after")

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        by_cron, weekly = (self.cron, self.hours), (self.days, self.start, self.end)
        complete = (None not in by_cron and weekly == (None, None, None)) or (None not in weekly and by_cron == (None, None))
        if not complete:
            raise ValueError("expected either cron and hours, or days, start and end")
        if any(moment is not None and moment.tzinfo is not None for moment in (self.start, self.end)):
            raise ValueError("expected start and end without an offset: timezone says it")
        return self
