"""Watches for a table in force that Abbe did not push and verify: seen within seconds, reported once, shown until a person has looked.

Modbus asks nobody for a password: whoever is in the machine's network can put any table into force. Nothing here writes to the
controller or takes anything back: which table is right is a person's word (``abbe accept-table``).
"""

from __future__ import annotations

from collections.abc import Callable, MutableSequence

import structlog

from abbe.drivers.errors import DriverError
from abbe.service.clock import Clock
from abbe.service.errors import AbbeError
from abbe.service.scheduler.loop import Alarms
from abbe.service.tables.in_force import InForce, LookAtTable
from abbe.service.tables.table_gate import STRANGE as STRANGE_TABLE
from abbe.service.verification.verified_by import STRANGE_TABLE as STRANGE_TABLE_CODE

log = structlog.get_logger("abbe.table")

LOOK_S = 10.0
AGAIN_S = 1.0
"""A first difference is looked at once more after this: a push of another process may have ended between both readings."""
CODE = STRANGE_TABLE_CODE
REMEDY = "find out who wrote it; restore the right table at the controller, or, if this one is right: abbe accept-table MACHINE.toml"
"""Neither a rollback nor a push: both are refused while such a table is in force (`abbe.service.tables.table_gate`)."""


class TableWatch:
    """Looks at the table in force while no job has the machine.

    Parameters
    ----------
    look : LookAtTable
        One look; it raises what devices and store raise.
    alarms : Alarms
        Gets each strange table once.
    attention : list of str
        What the page shows until the table is one that Abbe knows.
    clock : Clock
        Pauses.
    changed : callable
        Called when ``attention`` has changed.
    """

    def __init__(
        self, look: LookAtTable, alarms: Alarms, attention: MutableSequence[str], clock: Clock, changed: Callable[[], None]
    ) -> None:
        self._look, self._alarms, self._attention = look, alarms, attention
        self._clock, self._changed = clock, changed
        self._first: int | None = None
        """CRC that stands for the journal's while there is none: that of the first look at a table with which nothing was wrong."""
        self._told: tuple[int, str] | None = None

    async def run(self) -> None:
        """Look for ever. A controller that does not answer says nothing about its table: others tell that."""
        while True:
            seen = await self._one()
            if seen is not None and self._strange(seen):
                await self._clock.sleep(AGAIN_S)
                again = await self._one()
                seen = again if again is not None and again.crc == seen.crc else None
            if seen is not None:
                await self._judge(seen)
            await self._clock.sleep(LOOK_S)

    async def _one(self) -> InForce | None:
        try:
            seen = await self._look()
        except (AbbeError, DriverError, OSError):  # in use, out of reach, restarting: the next look is soon
            return None
        if seen.wanted is None and self._first is None and not seen.strange and not seen.unverified:
            self._first = seen.crc
        return seen if seen.settled else None

    def _strange(self, seen: InForce) -> str:
        """What is wrong with the table in force; empty: nothing."""
        wanted = seen.wanted if seen.wanted is not None else self._first
        here = f"bank {seen.bank} has CRC {seen.crc:08X}"
        whose = f"that of {seen.unverified}, which was never verified" if seen.unverified else ""
        if wanted is not None and seen.crc != wanted:
            text = f"somebody else changed the compensation in force: {here}, expected is {wanted:08X}"
            return f"{text}; it is {whose}" if whose else text
        if whose:
            return f"the compensation in force is unverified: {here}, {whose}"
        return f"{STRANGE_TABLE} is in force: {here}" if seen.strange else ""

    async def _judge(self, seen: InForce) -> None:
        text = self._strange(seen)
        if not text:
            self._show(None)
            return
        if self._told is not None and self._told[0] == seen.crc:
            return
        log.error("the table in force is not ours", bank=seen.bank, crc=f"{seen.crc:08X}", why=text)
        self._show((seen.crc, f"{CODE}: {text} - {REMEDY}"))
        await self._alarms.alarm({"code": CODE, "what": text, "remedy": REMEDY, "at_utc": self._clock.utc().isoformat()})

    def _show(self, told: tuple[int, str] | None) -> None:
        if told == self._told:
            return
        if self._told is not None:
            self._attention.remove(self._told[1])
        if told is not None:
            self._attention.append(told[1])
        self._told = told
        self._changed()
