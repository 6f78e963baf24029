"""Trouble on a link as an account that a person can read: one entry when it is noticed, one when it is over, however often it is met.

And how long to wait before the next try at a link that is down (`Backoff`).
"""

from __future__ import annotations

import asyncio
import random
import time
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from abbe.drivers.errors import NO_RUN, DriverError

_KEPT = 256


@dataclass(frozen=True, slots=True)
class Incident:
    """One entry.

    Parameters
    ----------
    kind : str
        ``detected`` or ``outcome``.
    code, device, run, text : str
        Of the first error of the trouble.
    host_s : float
        Monotonic host seconds.
    state : str
        Of an outcome: ``recovered`` (it answers again), ``accepted`` (it was identified anew), ``closed``.
    times : int
        Of an outcome: how many errors belonged to it.
    """

    kind: str
    code: str
    device: str
    run: str
    text: str
    host_s: float
    state: str = ""
    times: int = 1


class Incidents:
    """The latest incidents of one link, at most one of them open.

    Parameters
    ----------
    listen : callable, optional
        Is called with every entry; must not block or raise.

    Attributes
    ----------
    run : str
        The run that the link serves now. What no caller asked for (the heartbeat, a cable that is pulled) happens to it, too.
    """

    def __init__(self, listen: Callable[[Incident], None] | None = None) -> None:
        self.listen = listen
        self.run = NO_RUN
        self.entries: deque[Incident] = deque(maxlen=_KEPT)
        self._open: DriverError | None = None
        self._latched = False
        self._times = 0

    @property
    def open(self) -> DriverError | None:
        """The error that began the present trouble; None when there is none."""
        return self._open

    def note(self, error: DriverError, *, latched: bool = False) -> None:
        """Note an error as it goes to the caller or was overcome. Only the first of a trouble makes an entry.

        Parameters
        ----------
        latched : bool
            A good reply does not end this trouble (another device, a restart): the device has to be identified anew.
        """
        if error.run == NO_RUN:
            error.run = self.run
        self._latched = self._latched or latched
        self._times += 1
        if self._open is None:
            self._open = error
            self._add("detected", error)

    def good(self) -> None:
        """A request was answered as it should be: what was not latched is over."""
        if not self._latched:
            self._end("recovered")

    def accepted(self) -> None:
        """The device was identified anew: every trouble is over."""
        self._end("accepted")

    def closed(self) -> None:
        """The link is closed: nothing more will come of it."""
        self._end("closed")

    def _end(self, state: str) -> None:
        if self._open is not None:
            self._add("outcome", self._open, state)
        self._open, self._latched, self._times = None, False, 0

    def _add(self, kind: str, error: DriverError, state: str = "") -> None:
        entry = Incident(kind, error.code, error.device, error.run, str(error), time.monotonic(), state, max(self._times, 1))
        self.entries.append(entry)
        if self.listen is not None:
            self.listen(entry)


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
