"""Incidents of a link as a readable list. An incident has two entries, its detection and its outcome, however many errors it has.

`Backoff` determines the wait before the next attempt at a lost link.
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
    """One entry in the list of incidents.

    ``kind``: ``detected`` or ``outcome``; ``code``, ``device``, ``run``, ``text``: those of the first error; ``host_s``: monotonic host
    seconds; ``state`` of an outcome: ``recovered`` (the device answers again), ``accepted`` (identified anew), ``closed``; ``times`` of an
    outcome: number of errors in the incident.
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

    ``listen`` is called with every entry and must not block or raise. ``run``: the run that the link serves now; errors without a caller
    (heartbeat, pulled cable) belong to this run, too.
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
        """First error of the open incident, or None."""
        return self._open

    def note(self, error: DriverError, *, latched: bool = False) -> None:
        """Note an error, even if a retry overcame it. Only the first error of an incident makes an entry.

        ``latched``: a good reply does not end the incident, because another or a restarted device must be identified anew.
        """
        if error.run == NO_RUN:
            error.run = self.run
        self._latched = self._latched or latched
        self._times += 1
        if self._open is None:
            self._open = error
            self._add("detected", error)

    def good(self) -> None:
        """Note a good reply: it ends an incident that is not latched."""
        if not self._latched:
            self._end("recovered")

    def accepted(self) -> None:
        """Note that the device was identified anew: this ends any incident."""
        self._end("accepted")

    def closed(self) -> None:
        """Note that the link closed: this ends any incident."""
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
    """Waits between attempts: none, then 0.5 s, 1 s, 2 s ... 30 s, each with 20 % jitter, so that hosts do not retry in step.

    A connection proves nothing, because a controller may accept and close it: only ``succeeded`` resets the waits. At most eight attempts
    fall into the first minute. ``clock``, ``sleep`` and ``draw`` (uniform in 0..1) can be replaced in tests.
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
        """Return the seconds until the next attempt is due; 0 if it is due now."""
        return max(0.0, self._next_s - self._clock())

    async def due(self) -> None:
        """Wait until the next attempt is due."""
        while (left_s := self.left_s()) > 0:
            await self._sleep(left_s)

    def attempted(self) -> None:
        """Count an attempt, successful or not."""
        self._wait_s = min(2 * self._wait_s or self._first_s, self._longest_s)
        self._next_s = self._clock() + self._wait_s * (1 + self._jitter * (2 * self._draw() - 1))

    def succeeded(self) -> None:
        """Reset the waits after an answered request."""
        self._wait_s, self._next_s = 0.0, float("-inf")
