"""When a schedule is due, found without cronsim: every minute of the years is looked at, with the zone's offset from zoneinfo.

The rules are those of docs/how-to/schedule.md: a time that does not exist is due once, at the first minute after the gap; a time
that exists twice is due at its first; an expression whose minute or hour is a star runs through as the clock shows it; intervals
are counted in UTC.
"""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from zoneinfo import ZoneInfo

import numpy as np

OFFSETS_EVERY_MIN = 30
"""No zone of these tests changes its clocks at another instant than a full or half hour of UTC."""


class Minutes:
    """Every minute of a span in one zone: where its wall clock stands."""

    def __init__(self, zone: str, start: datetime, end: datetime) -> None:
        start = start.replace(minute=start.minute // OFFSETS_EVERY_MIN * OFFSETS_EVERY_MIN, second=0)
        count = int((end - start).total_seconds() // 60) + 1
        where = ZoneInfo(zone)
        steps = range(0, count + OFFSETS_EVERY_MIN, OFFSETS_EVERY_MIN)
        offsets = [(start + timedelta(minutes=k)).astimezone(where).utcoffset().total_seconds() / 60 for k in steps]  # type: ignore[union-attr]
        first = int(start.timestamp() // 60)
        self.utc = first + np.arange(count)
        self.local = self.utc + np.repeat(np.array(offsets, dtype=np.int64), OFFSETS_EVERY_MIN)[:count]
        self._shown = _shown(self.local)

    def at(self, which: np.ndarray) -> list[datetime]:
        return [datetime.fromtimestamp(int(minute) * 60, UTC) for minute in self.utc[which]]

    def of_cron(self, cron: str) -> list[datetime]:
        fields = cron.split()
        due = _fit(self._shown, fields)
        if not fields[0].startswith("*") and not fields[1].startswith("*"):
            seen = np.maximum.accumulate(self.local)
            due[1:] &= self.local[1:] > seen[:-1]  # a wall time that was there before
            for k in np.flatnonzero(np.diff(self.local) > 1) + 1:
                skipped = np.arange(self.local[k - 1] + 1, self.local[k])
                due[k] |= bool(_fit(_shown(skipped), fields).any())
        return self.at(due)

    def of_interval(self, every_min: int, first: datetime) -> list[datetime]:
        return self.at((self.utc - int(first.timestamp() // 60)) % every_min == 0)


def _shown(local: np.ndarray) -> tuple[np.ndarray, ...]:
    """Minute, hour, day, month and weekday of a wall clock that stands at these minutes (since 1970)."""
    stamp = local.astype("datetime64[m]")
    days, months = stamp.astype("datetime64[D]"), stamp.astype("datetime64[M]")
    of_month = (days - months.astype("datetime64[D]")).astype(int) + 1
    of_week = (days.astype(int) + 3) % 7 + 1  # 1970-01-01 was a Thursday
    found = (local % 60, local // 60 % 24, of_month, months.astype(int) % 12 + 1, of_week)
    return tuple(one.astype(np.int8) for one in found)


def _fit(shown: tuple[np.ndarray, ...], fields: list[str]) -> np.ndarray:
    """Whether what is shown fits the five fields."""
    minute, hour, dom, month, dow = (_fits(field, values) for field, values in zip(fields, shown, strict=True))
    both = fields[2].startswith("*") or fields[4].startswith("*")
    return minute & hour & month & ((dom & dow) if both else (dom | dow))


def _fits(field: str, values: np.ndarray) -> np.ndarray:
    fits = np.zeros(len(values), dtype=bool)
    for part in field.split(","):
        span, _, step = part.partition("/")
        low, _, high = span.partition("-")
        inside = np.ones(len(values), dtype=bool) if span == "*" else (values >= int(low)) & (values <= int(high or low))
        fits |= inside & ((values - (0 if span == "*" else int(low))) % int(step or 1) == 0)
    return fits
