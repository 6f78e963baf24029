"""The service's clocks: monotonic for waiting and for differences, UTC for people and for slots."""

from __future__ import annotations

import asyncio
import time
from datetime import UTC, datetime
from typing import Protocol


class Clock(Protocol):
    """What the service knows of time. Injected, so that tests drive weeks in milliseconds."""

    def monotonic_s(self) -> float:
        """Return seconds since an arbitrary moment; never jumps."""
        ...

    def utc(self) -> datetime:
        """Return the wall clock, aware, in UTC; may jump when somebody sets it."""
        ...

    async def sleep(self, s: float) -> None:
        """Wait ``s`` seconds of monotonic time."""
        ...


class SystemClock:
    """The clocks of this computer."""

    def monotonic_s(self) -> float:
        """Return seconds since an arbitrary moment; never jumps."""
        return time.monotonic()

    def utc(self) -> datetime:
        """Return the wall clock, aware, in UTC."""
        return datetime.now(UTC)

    async def sleep(self, s: float) -> None:
        """Wait ``s`` seconds of monotonic time."""
        await asyncio.sleep(max(s, 0.0))
