"""What an earlier end has left open - runs in segments, a push on its way - is looked for at start, and told until it is closed."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, MutableSequence

import structlog

from drivers.errors import DriverError
from service.clock import Clock
from service.core.jobs import Place
from service.errors import AbbeError, UnsafeToMove
from service.scheduler import record
from service.scheduler.loop import Alarms

log = structlog.get_logger("abbe.recovery")

AGAIN_S = 30.0
BUSY_S = 1.0
NAME = "taking back what an earlier end has left open"

Recover = Callable[[], Awaitable[str | None]]
"""``await recover()``: closes what is open; returns what was done, or nothing. Opens the controller only if a push is open."""


class OpenEnds:
    """Tries until nothing is open.

    Parameters
    ----------
    recover : callable
        One try.
    place : Place
        The machine is ours during a try: no check starts meanwhile.
    alarms : Alarms
        Told of each new reason why it is not possible.
    attention : list of str
        What the page shows until it is done.
    clock : Clock
        Pauses between tries.
    changed : callable
        Told when ``attention`` has changed.
    """

    def __init__(
        self,
        recover: Recover,
        place: Place,
        alarms: Alarms,
        attention: MutableSequence[str],
        clock: Clock,
        changed: Callable[[], None],
    ) -> None:
        self._recover, self._place, self._alarms = recover, place, alarms
        self._attention, self._clock, self._changed = attention, clock, changed
        self._told: str | None = None

    async def run(self) -> None:
        """Return when nothing is open any more."""
        while not await self._try():
            await self._clock.sleep(AGAIN_S)

    async def _try(self) -> bool:
        while self._place.take(NAME):  # a check runs: before it moved anything it has closed what was open
            await self._clock.sleep(BUSY_S)
        try:
            done = await self._recover()
        except (AbbeError, DriverError, OSError) as trouble:
            if type(trouble) is UnsafeToMove:  # another process has the machine, or is in the middle of its push
                log.info("waiting for another process", cause=str(trouble))
            else:
                await self._tell(trouble)
            return False
        finally:
            self._place.give_back()
        if done:
            log.warning("what an earlier end had left open is closed", what=done)
        self._show(None)
        return True

    async def _tell(self, trouble: Exception) -> None:
        cause = record.cause_of(trouble)
        text = f"{cause['code']}: {cause['what']}" + (f" - {cause['remedy']}" if cause["remedy"] else "")
        if text == self._told:
            return
        self._show(text)
        log.error("what an earlier end has left open cannot be closed", **cause)
        await self._alarms.alarm({**cause, "at_utc": self._clock.utc().isoformat()})

    def _show(self, text: str | None) -> None:
        if self._told is not None:
            self._attention.remove(self._told)
        if text is not None:
            self._attention.append(text)
        self._told = text
        self._changed()
