"""Convert a cron expression with its time zone, or an interval, to UTC slots. Pure: no clock, no state.

A slot is a UTC instant at which a schedule is due. Daylight saving is handled only here: a time that does not exist (spring) is due once,
at the first instant after the gap; a time that exists twice (autumn) is due once, at its first occurrence; expressions that repeat every
few minutes run through both hours. Intervals count in UTC from a fixed instant, so that every process and every restart finds the same
slots. Windows, for maintenance and for staffed hours, are judged in the wall time of their zone.

cronsim is used on wall times without a zone: given a zone, it loses slots where the clocks change by half an hour
(``20 */6 * * *`` in Australia/Lord_Howe, 2026-04-05 06:20; found by tests/service/core/test_two_years.py).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from datetime import UTC, datetime, time, timedelta
from functools import lru_cache
from typing import get_args
from zoneinfo import ZoneInfo

from cronsim import CronSim

from abbe.service.domain.schedule import Day, Schedule, Window


def slots_after(schedule: Schedule, after_utc: datetime) -> Iterator[datetime]:
    """Yield the UTC slots strictly later than ``after_utc``, in order, each once."""
    last = after_utc.astimezone(UTC)
    if schedule.every_h:
        yield from _interval_after(schedule, last)
        return
    for slot in due_after(schedule.cron, ZoneInfo(schedule.timezone), last):
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
    early = (until - CLOCK_CHANGE).astimezone(zone).replace(tzinfo=None)
    before = next(CronSim(schedule.cron, early, reverse=True), None)
    found = None
    start = until - CLOCK_CHANGE if before is None else instant(before, zone) - CLOCK_CHANGE
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


def time_rule(schedule: Schedule) -> str:
    """Return what decides when a schedule is due, as one text: schedules with the same text have the same slots."""
    return f"{schedule.cron}|{schedule.timezone}|{schedule.every_h:.17g}|{schedule.first.astimezone(UTC).isoformat()}"


def rule_as_text(schedule: Schedule) -> str:
    """Return the schedule as a sentence, for people."""
    if schedule.every_h:
        every = f"{schedule.every_h:g} hours" if schedule.every_h >= 1.0 else f"{60.0 * schedule.every_h:.3g} minutes"
        return f"Every {every}, counted from {schedule.first.astimezone(UTC):%Y-%m-%d %H:%M} UTC"
    return CronSim(schedule.cron, datetime(2026, 1, 1, tzinfo=UTC)).explain()


CLOCK_CHANGE = timedelta(hours=3)
"""No zone changes its clocks by more than this."""

_STRIDE = timedelta(days=7)
"""No zone changes its clocks twice within this time."""

_SECOND = timedelta(seconds=1)


def runs_through(cron: str) -> bool:
    """Return whether an expression runs in both hours of the autumn change: its minute or its hour begins with a star."""
    minute, hour = cron.split()[-5:-3]
    return minute.startswith("*") or hour.startswith("*")


def due_after(cron: str, zone: ZoneInfo, after: datetime) -> Iterator[datetime]:
    """Yield UTC instants in order, from about ``after`` (UTC) on: some may lie before it, some may be repeated."""
    return _by_the_clock(cron, zone, after) if runs_through(cron) else _fixed_times(cron, zone, after)


def _fixed_times(cron: str, zone: ZoneInfo, after: datetime) -> Iterator[datetime]:
    for local in CronSim(cron, (after.astimezone(zone) - CLOCK_CHANGE).replace(tzinfo=None)):
        yield instant(local, zone)


def _by_the_clock(cron: str, zone: ZoneInfo, after: datetime) -> Iterator[datetime]:
    """Yield UTC instants: cronsim counts in wall time between two clock changes, and restarts at each change."""
    while True:
        offset = after.astimezone(zone).utcoffset() or timedelta(0)
        change: datetime | None = None
        last = after
        for local in CronSim(cron, (after + offset).replace(tzinfo=None)):
            slot = local.replace(tzinfo=UTC) - offset
            change = next_change(zone, last, slot)
            if change is not None:
                break
            last = slot
            yield slot
        if change is None:
            return
        if (first := instant_shown(cron, zone, change)) is not None:
            yield first
        after = change


def instant_shown(cron: str, zone: ZoneInfo, at: datetime) -> datetime | None:
    """Return ``at`` if the expression matches the wall time then, else None."""
    local = at.astimezone(zone).replace(tzinfo=None)
    return at if next(iter(CronSim(cron, local - _SECOND)), None) == local else None


def instant(local: datetime, zone: ZoneInfo) -> datetime:
    """Return when the zone's wall clock first shows ``local``; for a skipped time, the first instant after the gap."""
    found = local.replace(tzinfo=zone).astimezone(UTC)
    if found.astimezone(zone).replace(tzinfo=None) == local:
        return found
    return next_change(zone, found - CLOCK_CHANGE, found) or found


def next_change(zone: ZoneInfo, after: datetime, until: datetime) -> datetime | None:
    """Return the first instant later than ``after`` and not later than ``until`` at which the zone's clocks change (all UTC), or None."""
    low, offset = after, after.astimezone(zone).utcoffset()
    while low < until:
        high = min(low + _STRIDE, until)
        if high.astimezone(zone).utcoffset() != offset:
            return _bisected(zone, low, high)
        low = high
    return None


def _bisected(zone: ZoneInfo, low: datetime, high: datetime) -> datetime:
    offset = low.astimezone(zone).utcoffset()
    while high - low > _SECOND:
        middle = (low + (high - low) / 2).replace(microsecond=0)
        if middle <= low:
            break
        low, high = (middle, high) if middle.astimezone(zone).utcoffset() == offset else (low, middle)
    return high


DAYS = get_args(Day)


def covers(window: Window, at_utc: datetime) -> bool:
    """Return whether an instant lies in the window: the start is inside, the end is not."""
    if window.cron:
        begun = _begun(window.cron, window.timezone, at_utc)
        return begun is not None and at_utc < begun + timedelta(hours=window.hours)
    local = at_utc.astimezone(ZoneInfo(window.timezone))
    today, yesterday = DAYS[local.weekday()] in window.days, DAYS[local.weekday() - 1] in window.days
    now, start, end = local.time(), window.start or time(0), window.end or time(0)
    if start < end:
        return today and start <= now < end
    return (today and now >= start) or (yesterday and now < end)


def _begun(cron: str, timezone: str, at_utc: datetime) -> datetime | None:
    """Return the last match of a cron expression, cached: it changes far less often than it is asked for."""
    known = _known(cron, timezone)
    if not known or not known[0] <= at_utc < known[1]:
        schedule = Schedule("", cron, timezone, "")
        last, following = previous_slot(schedule, at_utc), next_slot(schedule, at_utc)
        if last is None or following is None:
            return last
        known[:] = [last, following]
    return known[0]


@lru_cache(maxsize=64)
def _known(cron: str, timezone: str) -> list[datetime]:
    return []


def covering(windows: Iterable[Window], at_utc: datetime) -> Window | None:
    """Return the first window that an instant lies in, or None."""
    return next((window for window in windows if covers(window, at_utc)), None)
