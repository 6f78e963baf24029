"""Recovery of what an earlier end left open - runs in segments, a push under way: at start, and reported until it is closed.

A push of the running service can be left open too, with a table in force that nobody has verified: it is gone back to in the same way.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, MutableSequence

import structlog

from abbe.drivers.errors import DriverError
from abbe.service.clock import Clock
from abbe.service.core.jobs import MachineClaim
from abbe.service.errors import AbbeError, MachineInUse
from abbe.service.scheduler import record
from abbe.service.scheduler.loop import Alarms

log = structlog.get_logger("abbe.recovery")

AGAIN_S = 30.0
LOOK_S = 5.0
"""So often the journal is asked whether a push is open; the controller is not asked for that."""
BUSY_S = 1.0
NAME = "taking back what an earlier end has left open"

Recover = Callable[[], Awaitable[str | None]]
"""``await recover()``: closes what is open; returns what was done, or nothing. Opens the controller only if a push is open."""


IsOpen = Callable[[], Awaitable[bool]]
"""Whether the last push of the machine is open by its journal: also one that is under way now, or that a person has to look at."""


class PushRecovery:
    """Tries until nothing is open, and begins again when something is.

    Parameters
    ----------
    recover : callable
        One try.
    is_open : callable
        Asked after all was closed.
    place : MachineClaim
        The machine is ours during a try: no check starts meanwhile.
    alarms : Alarms
        Gets each new reason why it is not possible.
    attention : list of str
        What the page shows until it is done.
    clock : Clock
        Pauses between tries.
    changed : callable
        Called when ``attention`` has changed.
    """

    def __init__(
        self,
        recover: Recover,
        is_open: IsOpen,
        place: MachineClaim,
        alarms: Alarms,
        attention: MutableSequence[str],
        clock: Clock,
        changed: Callable[[], None],
    ) -> None:
        self._recover, self._is_open, self._place, self._alarms = recover, is_open, place, alarms
        self._attention, self._clock, self._changed = attention, clock, changed
        self._told: str | None = None

    async def run(self) -> None:
        """Work for ever: close what is open, then look whether a push of any process was left open since."""
        while True:
            while not await self._try():
                await self._clock.sleep(AGAIN_S)
            while not await self._left_open():
                await self._clock.sleep(LOOK_S)

    async def _left_open(self) -> bool:
        """Look at the journal alone: the machine is not locked where there is nothing to take back."""
        try:
            return await self._is_open()
        except AbbeError as trouble:  # a push or a check needs the same database: the next look is soon
            log.warning("whether a push is open cannot be read now", cause=trouble.detail)
            return False

    async def _try(self) -> bool:
        while self._place.take(NAME):  # a check runs, which has closed what was open before it moved anything; or the push itself
            await self._clock.sleep(BUSY_S)
        try:
            done = await self._recover()
        except (AbbeError, DriverError, OSError) as trouble:
            if isinstance(trouble, MachineInUse):
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
