"""The timetable: schedules, their conditions, windows in which nothing may start, and the next slot.

The machine file, the scheduler, the channel and the interfaces share these records, with limits and descriptions of their fields.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, time
from typing import Annotated, Literal
from zoneinfo import ZoneInfo

from cronsim import CronSim, CronSimError
from pydantic import AfterValidator, AwareDatetime, Field

from abbe.service.domain.document import WORD
from abbe.service.domain.machine_file import Loosens

FIRST_UTC = datetime(2026, 1, 1, tzinfo=UTC)
"""Instant from which intervals are counted, unless the machine file names another."""
SHORTEST_H = 1 / 60
"""The shortest interval of a schedule."""

Day = Literal["mon", "tue", "wed", "thu", "fri", "sat", "sun"]


def _cron(text: str) -> str:
    try:
        if text:
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


def _interval(hours: float) -> float:
    if hours and hours < SHORTEST_H:
        raise ValueError(f"expected at least a minute (1/60 h), got {hours:g} h")
    return hours


Name = Annotated[str, Field(min_length=1, max_length=WORD)]
Zone = Annotated[str, AfterValidator(_timezone), Field(description="IANA name, e.g. Europe/Berlin")]
Cron = Annotated[str, AfterValidator(_cron)]


@dataclass(frozen=True, slots=True)
class Needs:
    """Conditions for the start of a check; during its grace the check waits for them."""

    idle: Annotated[bool, Loosens("less"), Field(description="controller ready, nothing moves, no NC program, spindle off")] = False
    warm_min: Annotated[
        float,
        Loosens("less"),
        Field(
            ge=0.0,
            le=50.0,
            description="least number of minutes, of the last 60, in which the service saw the spindle turn or an axis move",
        ),
    ] = 0.0
    air: Annotated[bool, Loosens("less"), Field(description="air temperature (of the laser) inside [limits] temperature_c")] = False
    operator: Annotated[
        Literal["any", "present", "absent"],
        Loosens("dropped"),
        Field(description="present: only in the hours of [[staffed]]; absent: only outside them, with the door shut and the mode remote"),
    ] = "any"


@dataclass(frozen=True, slots=True)
class Schedule:
    """One line of the timetable: by cron expression or by interval. Its name is part of the key by which each slot runs only once."""

    name: Annotated[Name, Loosens("stated")]
    cron: Annotated[
        Cron, Loosens("changed"), Field(description="minute hour day month weekday, e.g. 0 6 * * 1 (Monday); six fields: seconds first")
    ] = ""
    timezone: Annotated[Zone, Loosens("changed")] = "UTC"
    recipe: Annotated[Name, Loosens("changed"), Field(description="what to measure")] = "quick-check"
    grace_s: Annotated[
        float,
        Loosens("more"),
        Field(ge=1.0, le=86_400.0, description="how late a slot may start; after that it counts as missed"),
    ] = 300.0
    every_h: Annotated[
        float,
        AfterValidator(_interval),
        Loosens("changed"),
        Field(le=8784.0, description="instead of cron: interval in hours (1/60 or more)"),
    ] = 0.0
    first: Annotated[
        AwareDatetime, Loosens("changed"), Field(description="a moment from which every_h is counted, e.g. 2026-11-02T06:00:00+01:00")
    ] = FIRST_UTC
    catch_up: Annotated[
        Literal["skip", "once"],
        Loosens("raised"),
        Field(description="missed slots are recorded; skip: nothing runs for them; once: one run for all of them"),
    ] = "skip"
    needs: Needs = Needs()
    on_alarm: Annotated[
        Literal["none", "propose"],
        Loosens("raised"),
        Field(
            description="propose: when a check raises an alarm, the service measures the [alarm] campaign, solves and searches it, and "
            "proposes tables, which wait for approval"
        ),
    ] = "none"


def one_way(schedule: Schedule) -> Schedule:
    """Return a valid schedule of the machine file.

    Raises
    ------
    ValueError
        The schedule has neither a cron expression nor an interval, or both, or ``first`` without an interval.
    """
    if bool(schedule.cron) == bool(schedule.every_h):
        raise ValueError(f"expected either cron = ... or every_h = ..., got {'both' if schedule.cron else 'neither'}")
    if schedule.first != FIRST_UTC and not schedule.every_h:
        raise ValueError("first = ... needs every_h = ...: a cron expression has no first time")
    return schedule


@dataclass(frozen=True, slots=True)
class Window:
    """A window in time: a number of hours from each time of a cron expression, or from start to end on some days of the week.

    Hours count elapsed time, even when the clocks change; start and end are wall time.
    """

    name: Name
    timezone: Zone = "UTC"
    cron: Annotated[Cron, Field(description="when it begins, e.g. 0 14 * * 5")] = ""
    hours: Annotated[float, Field(ge=0.0, le=744.0, description="how long it lasts, with cron")] = 0.0
    days: Annotated[frozenset[Day], Field(description='instead of cron: days on which it begins, e.g. ["sat", "sun"]')] = frozenset()
    start: Annotated[time | None, Field(description="wall time, with days, e.g. 22:00:00")] = None
    end: Annotated[time | None, Field(description="wall time; if not later than start, the window ends on the next day")] = None


def complete(window: Window) -> Window:
    """Return a valid window of the machine file.

    Raises
    ------
    ValueError
        The window is neither by cron expression nor weekly, or both; or its wall times carry an offset.
    """
    weekly = (bool(window.days), window.start is not None, window.end is not None)
    by_cron = (bool(window.cron), bool(window.hours))
    if not ((all(by_cron) and not any(weekly)) or (all(weekly) and not any(by_cron))):
        raise ValueError("expected either cron and hours, or days, start and end")
    if any(wall is not None and wall.tzinfo is not None for wall in (window.start, window.end)):
        raise ValueError("expected start and end without a UTC offset: timezone defines it")
    return window


@dataclass(frozen=True, slots=True, kw_only=True)
class DueSlot:
    """The next slot of one schedule."""

    schedule: Schedule
    slot_utc: datetime
