"""The service's clocks: monotonic for waiting and for durations, UTC for people and for slots."""

from __future__ import annotations

import asyncio
import time
from datetime import UTC, datetime
from typing import Protocol


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
