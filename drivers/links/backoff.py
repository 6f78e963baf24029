"""How long to leave a device alone between two attempts to connect: longer each time, and short again only after it has really answered."""

from __future__ import annotations

import asyncio
import random
import time
from collections.abc import Awaitable, Callable

FIRST_S = 0.5
LONGEST_S = 30.0
JITTER = 0.2


class Backoff:
    """Waiting times of one device: at once, then 0.5 s, 1 s, 2 s ... 30 s, each 20 % more or less, so that hosts do not knock together.

    A connection that is made proves nothing: a controller may accept and close. Only ``succeeded`` starts anew. At most eight attempts
    fall into the first minute.

    Parameters
    ----------
    first_s, longest_s : float
        Wait before the second attempt, and the longest one, in s.
    jitter : float
        Largest relative deviation of a wait.
    clock : callable
        Monotonic seconds.
    sleep : callable
        Waits for so many seconds.
    draw : callable
        Uniform in 0..1.
    """

    def __init__(
        self,
        first_s: float = FIRST_S,
        longest_s: float = LONGEST_S,
        jitter: float = JITTER,
        *,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
        draw: Callable[[], float] = random.random,
    ) -> None:
        self._first_s, self._longest_s, self._jitter = first_s, longest_s, jitter
        self._clock, self._sleep, self._draw = clock, sleep, draw
        self._next_s = float("-inf")
        self._wait_s = 0.0

    def left_s(self) -> float:
        """Seconds until the next attempt is due; 0 when it may be made now."""
        return max(0.0, self._next_s - self._clock())

    async def due(self) -> None:
        """Wait until the next attempt is due."""
        while (left_s := self.left_s()) > 0:
            await self._sleep(left_s)

    def attempted(self) -> None:
        """Count an attempt, whatever comes of it."""
        self._wait_s = min(2 * self._wait_s or self._first_s, self._longest_s)
        self._next_s = self._clock() + self._wait_s * (1 + self._jitter * (2 * self._draw() - 1))

    def succeeded(self) -> None:
        """Start anew: a request was answered."""
        self._wait_s, self._next_s = 0.0, float("-inf")
