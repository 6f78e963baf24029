"""Time windows: maintenance, in which nothing starts, and staffed hours. Pure, in the wall time of their zone."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime, time, timedelta
from functools import lru_cache
from typing import get_args
from zoneinfo import ZoneInfo

from abbe.service.domain.schedule import Day, Schedule, Window
from abbe.service.scheduler.slots import next_slot, previous_slot

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
