"""Windows in time: maintenance, in which nothing starts, and staffed hours. Pure, in the wall time of their zone."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime, time, timedelta
from functools import lru_cache
from zoneinfo import ZoneInfo

from abbe.service.domain.schedule import Schedule
from abbe.service.scheduler.slots import next_slot, previous_slot

DAYS = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")


@dataclass(frozen=True, slots=True)
class Window:
    """Either ``hours`` from each time of a cron expression, or from ``start`` to ``end`` on some days of the week.

    Parameters
    ----------
    name : str
        For people.
    timezone : str
        IANA name.
    cron : str
        When it begins; empty: weekly.
    hours : float
        How long it lasts then, h of real time, also where the clocks change in it.
    days : frozenset of str
        Of `DAYS`: the days on which a weekly window begins.
    start, end : time
        Wall time; an end that is not later than the start is on the day after.
    """

    name: str
    timezone: str
    cron: str = ""
    hours: float = 0.0
    days: frozenset[str] = frozenset()
    start: time = time(0)
    end: time = time(0)

    def covers(self, at_utc: datetime) -> bool:
        """Tell whether an instant lies in the window. Its first instant does, its end does not."""
        if self.cron:
            begun = _begun(self.cron, self.timezone, at_utc)
            return begun is not None and at_utc < begun + timedelta(hours=self.hours)
        local = at_utc.astimezone(ZoneInfo(self.timezone))
        today, yesterday = DAYS[local.weekday()] in self.days, DAYS[local.weekday() - 1] in self.days
        now = local.time()
        if self.start < self.end:
            return today and self.start <= now < self.end
        return (today and now >= self.start) or (yesterday and now < self.end)


def _begun(cron: str, timezone: str, at_utc: datetime) -> datetime | None:
    """Return the last time of a cron expression. It is asked for far more often than it changes."""
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
    return next((window for window in windows if window.covers(at_utc)), None)
