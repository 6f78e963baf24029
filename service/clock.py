"""The service's clocks: a monotonic one for waits and durations, and UTC for people and the timetable. Also the format of stored times."""

from __future__ import annotations

import asyncio
import time
from datetime import UTC, datetime
from typing import Protocol

from abbe.service.errors import StoreError


def utc_text(time: datetime) -> str:
    """Write a time in UTC, ISO 8601 with microseconds (``2026-11-21T03:34:03.000000Z``): text order is time order.

    Raises
    ------
    StoreError
        The time has no time zone.
    """
    if time.tzinfo is None:
        raise StoreError(f"time {time.isoformat()} has no time zone", "add one, e.g. Z for UTC")
    return time.astimezone(UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")


class Clock(Protocol):
    """The clocks that the service uses. Injected, so that tests run weeks in milliseconds."""

    def monotonic_s(self) -> float:
        """Return seconds since an arbitrary origin; never jumps."""
        ...

    def utc(self) -> datetime:
        """Return the wall clock, timezone-aware, in UTC; it may jump when the clock is set."""
        ...

    async def sleep(self, s: float) -> None:
        """Wait ``s`` seconds of monotonic time."""
        ...


class SystemClock:
    """The clocks of this computer."""

    def monotonic_s(self) -> float:
        """Return seconds since an arbitrary origin; never jumps."""
        return time.monotonic()

    def utc(self) -> datetime:
        """Return the wall clock, timezone-aware, in UTC."""
        return datetime.now(UTC)

    async def sleep(self, s: float) -> None:
        """Wait ``s`` seconds of monotonic time."""
        await asyncio.sleep(max(s, 0.0))
