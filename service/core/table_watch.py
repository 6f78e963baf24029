"""Watch for an active table that Abbe did not push and verify: detected within seconds, reported once, shown until a person has acted.

Modbus has no passwords: any computer in the machine's network can activate any table. Nothing here writes to the controller or rolls
back: which table is right is a person's decision (``abbe accept-table``).
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
"""A first difference is checked once more after this time, s: another process's push may have ended between two readings."""
CODE = STRANGE_TABLE_CODE
REMEDY = "find out who wrote it; restore the right table at the controller, or, if this one is right: abbe accept-table MACHINE.toml"
"""Neither a rollback nor a push: both are refused while such a table is active (`abbe.service.tables.table_gate`)."""


class TableWatch:
    """Looks at the table in force while no job has the machine.

    Parameters
    ----------
    look : LookAtTable
        One look; raises errors of devices and store.
    alarms : Alarms
        Gets each unknown table once.
    attention : list of str
        Texts on the page until the table is one that Abbe knows.
    changed : callable
        Called when ``attention`` has changed.
    """

    def __init__(
        self, look: LookAtTable, alarms: Alarms, attention: MutableSequence[str], clock: Clock, changed: Callable[[], None]
    ) -> None:
        self._look, self._alarms, self._attention = look, alarms, attention
        self._clock, self._changed = clock, changed
        self._first: int | None = None
        """CRC expected while the journal has none: that of the first table found without a problem."""
        self._reported: tuple[int, str] | None = None

    async def run(self) -> None:
        """Watch forever. A controller that does not answer says nothing about its table; other parts report that."""
        while True:
            in_force = await self._read()
            if in_force is not None and self._problem(in_force):
                await self._clock.sleep(AGAIN_S)
                again = await self._read()
                in_force = again if again is not None and again.crc == in_force.crc else None
            if in_force is not None:
                await self._judge(in_force)
            await self._clock.sleep(LOOK_S)

    async def _read(self) -> InForce | None:
        try:
            in_force = await self._look()
        except (AbbeError, DriverError, OSError):  # in use, out of reach, restarting: the next look is soon
            return None
        if in_force.wanted is None and self._first is None and not in_force.strange and not in_force.unverified:
            self._first = in_force.crc
        return in_force if in_force.settled else None

    def _problem(self, in_force: InForce) -> str:
        """Return what is wrong with the table in force; empty: nothing."""
        wanted = in_force.wanted if in_force.wanted is not None else self._first
        here = f"bank {in_force.bank} has CRC {in_force.crc:08X}"
        whose = f"that of {in_force.unverified}, which was never verified" if in_force.unverified else ""
        if wanted is not None and in_force.crc != wanted:
            text = f"somebody else changed the compensation in force: {here}, expected is {wanted:08X}"
            return f"{text}; it is {whose}" if whose else text
        if whose:
            return f"the compensation in force is unverified: {here}, {whose}"
        return f"{STRANGE_TABLE} is in force: {here}" if in_force.strange else ""

    async def _judge(self, in_force: InForce) -> None:
        text = self._problem(in_force)
        if not text:
            self._show(None)
            return
        if self._reported is not None and self._reported[0] == in_force.crc:
            return
        log.error("the table in force is not ours", bank=in_force.bank, crc=f"{in_force.crc:08X}", why=text)
        self._show((in_force.crc, f"{CODE}: {text} - {REMEDY}"))
        await self._alarms.alarm({"code": CODE, "what": text, "remedy": REMEDY, "at_utc": self._clock.utc().isoformat()})

    def _show(self, report: tuple[int, str] | None) -> None:
        if report == self._reported:
            return
        if self._reported is not None:
            self._attention.remove(self._reported[1])
        if report is not None:
            self._attention.append(report[1])
        self._reported = report
        self._changed()
