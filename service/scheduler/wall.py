"""Times that a cron expression names on a zone's wall clock, as UTC instants.

cronsim only counts here, on clocks without zones: with a zone of its own it loses slots where the clocks change by half an hour
(``20 */6 * * *`` in Australia/Lord_Howe, 2026-04-05 06:20; found by tests/service/core/test_two_years.py).
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from zoneinfo import ZoneInfo

from cronsim import CronSim

CLOCK_CHANGE = timedelta(hours=3)
"""No zone changes its clocks by more than this."""

_STRIDE = timedelta(days=7)
"""No zone changes its clocks and back again within this."""

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
    """Between two clock changes, wall time is UTC plus a constant: cronsim counts there, and restarts at each change."""
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
