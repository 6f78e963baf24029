"""Convert a cron expression with its time zone, or an interval, to UTC slots. Pure: no clock, no state.

A slot is a UTC instant at which a schedule is due. Daylight saving is handled only here: a time that does not exist (spring) is due once,
at the first instant after the gap; a time that exists twice (autumn) is due once, at its first occurrence; expressions that repeat every
few minutes run through both hours. Intervals count in UTC from a fixed instant, so that every process and every restart finds the same
slots.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from zoneinfo import ZoneInfo

from cronsim import CronSim

from abbe.service.domain.schedule import Schedule
from abbe.service.scheduler import wall


def slots_after(schedule: Schedule, after_utc: datetime) -> Iterator[datetime]:
    """Yield the UTC slots strictly later than ``after_utc``, in order, each once."""
    last = after_utc.astimezone(UTC)
    if schedule.every_h:
        yield from _interval_after(schedule, last)
        return
    for slot in wall.due_after(schedule.cron, ZoneInfo(schedule.timezone), last):
        # Two wall times can be one instant, and one can lie before the start.
        if slot > last:
            last = slot
            yield slot


def _interval_after(schedule: Schedule, after: datetime) -> Iterator[datetime]:
    step = timedelta(hours=schedule.every_h)
    number = (after - schedule.first) // step + 1
    while True:
        yield (schedule.first + number * step).astimezone(UTC)
        number += 1


def next_slot(schedule: Schedule, after_utc: datetime) -> datetime | None:
    """Return the first slot strictly later than ``after_utc``, or None if the expression never matches again."""
    return next(slots_after(schedule, after_utc), None)


def previous_slot(schedule: Schedule, until_utc: datetime) -> datetime | None:
    """Return the last slot not later than ``until_utc``, or None if there was none."""
    until = until_utc.astimezone(UTC)
    if schedule.every_h:
        step = timedelta(hours=schedule.every_h)
        return (schedule.first + (until - schedule.first) // step * step).astimezone(UTC)
    # Forward iteration defines the slots; iterating backwards only finds an early enough start.
    zone = ZoneInfo(schedule.timezone)
    early = (until - wall.CLOCK_CHANGE).astimezone(zone).replace(tzinfo=None)
    before = next(CronSim(schedule.cron, early, reverse=True), None)
    found = None
    start = until - wall.CLOCK_CHANGE if before is None else wall.instant(before, zone) - wall.CLOCK_CHANGE
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
    """Return the schedule as a sentence, for people."""
    if schedule.every_h:
        return f"Every {schedule.every_h:g} hours, counted from {schedule.first.astimezone(UTC):%Y-%m-%d %H:%M} UTC"
    return CronSim(schedule.cron, datetime(2026, 1, 1, tzinfo=UTC)).explain()
