"""Cron expression and time zone to UTC slots. Pure: no clock, no state.

A slot is a UTC instant at which a schedule is due. Daylight saving is settled here and nowhere else: a time that does not
exist (spring) fires once, at the first instant after the gap; a time that exists twice (autumn) fires once, at its first
occurrence; expressions that run every so many minutes run through both hours.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from cronsim import CronSim, CronSimError

from service.errors import ConfigError

# A fixed time is moved by at most the size of a clock change. No zone changes by more than this.
_CLOCK_CHANGE = timedelta(hours=3)


@dataclass(frozen=True, slots=True)
class Schedule:
    """One line of the machine file's timetable.

    Parameters
    ----------
    name : str
        Unique within the machine; part of the key that makes a slot run once.
    cron : str
        Five fields (minute hour day month weekday, 1 = Monday), or six with seconds first.
    timezone : str
        IANA name, for example ``Europe/Berlin``.
    recipe : str
        What to run.
    grace_s : float
        A slot found later than this is recorded as missed and not run.
    """

    name: str
    cron: str
    timezone: str
    recipe: str
    grace_s: float = 300.0


def checked(schedule: Schedule) -> Schedule:
    """Return the schedule itself if its expression and zone can be used.

    Raises
    ------
    ConfigError
        Names the schedule, and says what is wrong with its expression or zone.
    """
    where = f"schedule {schedule.name!r}"
    try:
        zone = ZoneInfo(schedule.timezone)
    except (ZoneInfoNotFoundError, ValueError, OSError) as wrong:
        raise ConfigError(
            f"{where}: there is no time zone {schedule.timezone!r}", "use an IANA name such as Europe/Berlin or UTC"
        ) from wrong
    try:
        CronSim(schedule.cron, datetime(2026, 1, 1, tzinfo=zone))
    except CronSimError as wrong:
        raise ConfigError(
            f"{where}: cron expression {schedule.cron!r}: {wrong}", "write: minute hour day month weekday, e.g. 0 6 * * 1"
        ) from wrong
    return schedule


def slots_after(schedule: Schedule, after_utc: datetime) -> Iterator[datetime]:
    """Yield the UTC slots strictly later than ``after_utc``, in order, each once."""
    last = after_utc.astimezone(UTC)
    for local in CronSim(schedule.cron, last.astimezone(ZoneInfo(schedule.timezone))):
        slot = local.astimezone(UTC)
        # Wall times lose their fold inside cronsim: two of them can be one instant, and one can lie before the start.
        if slot > last:
            last = slot
            yield slot


def next_slot(schedule: Schedule, after_utc: datetime) -> datetime | None:
    """Return the first slot strictly later than ``after_utc``, or None if the expression never matches again."""
    return next(slots_after(schedule, after_utc), None)


def previous_slot(schedule: Schedule, until_utc: datetime) -> datetime | None:
    """Return the last slot not later than ``until_utc``, or None if there never was one."""
    until = until_utc.astimezone(UTC)
    # Forward iteration defines the slots; walking backwards only finds a place to start from that is early enough.
    zone = ZoneInfo(schedule.timezone)
    before = next(CronSim(schedule.cron, (until - _CLOCK_CHANGE).astimezone(zone), reverse=True), None)
    found = None
    start = until - _CLOCK_CHANGE if before is None else before.astimezone(UTC) - _CLOCK_CHANGE
    for slot in slots_after(schedule, start):
        if slot > until:
            break
        found = slot
    return found


def slots_between(schedule: Schedule, after_utc: datetime, until_utc: datetime) -> Iterator[datetime]:
    """Yield the slots later than ``after_utc`` and not later than ``until_utc``."""
    for slot in slots_after(schedule, after_utc):
        if slot > until_utc:
            return
        yield slot


def cron_in_words(schedule: Schedule) -> str:
    """Return the expression as a sentence, for people."""
    return CronSim(schedule.cron, datetime(2026, 1, 1, tzinfo=UTC)).explain()
