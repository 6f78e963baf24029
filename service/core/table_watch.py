"""Watch for an active table that Abbe did not push and verify: detected within seconds, reported once, shown until a person has acted.

Modbus has no passwords: any computer in the machine's network can activate any table. This module never writes to the controller:
a person decides which table is right (``abbe accept-table``).
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, MutableSequence
from dataclasses import dataclass

import structlog

from abbe.drivers.api import TableController
from abbe.drivers.errors import DriverError
from abbe.service.clock import Clock
from abbe.service.devices.session import DeviceUrls, lock_machine, open_session
from abbe.service.errors import AbbeError, TableMismatch
from abbe.service.scheduler.loop import AlarmSink
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables import table_gate
from abbe.service.tables.known_tables import KnownTables, known_tables
from abbe.service.tables.push_journal import JournalView
from abbe.service.tables.table_gate import STRANGE as STRANGE_TABLE
from abbe.service.tables.table_gate import InForceNow
from abbe.service.verification.verified_by import STRANGE_TABLE as STRANGE_TABLE_CODE


@dataclass(frozen=True, slots=True)
class InForce:
    """The table in force at one time, and the table that the journal expects.

    Parameters
    ----------
    bank, crc : int
        The active bank and the CRC-32 of its content.
    wanted : int or None
        CRC of the table that was kept or accepted last, else of the one that the first push found; None: not known.
    settled : bool
        False while a push is under way or waits for a person; a comparison then means nothing.
    unverified : str
        The push that wrote the table, if nothing has verified it; else empty.
    strange : bool
        The table corrects something or cannot be read, and is in no journal of this control.
    """

    bank: int
    crc: int
    wanted: int | None
    settled: bool = True
    unverified: str = ""
    strange: bool = False


LookAtTable = Callable[[], Awaitable[InForce]]


def look_at_table(site: Site, store: Store) -> LookAtTable:
    """Return a reader of the table in force. It reads registers only and raises `UnsafeToMove` while any process uses the machine."""

    corrects: dict[int, bool] = {}  # cache for tables that no journal knows: their bytes are read once, not every ten seconds

    async def look() -> InForce:
        with lock_machine(site.urls.cnc):
            pass  # released at once: reading must not block a measurement
        async with open_session(DeviceUrls(cnc=site.urls.cnc)) as session:
            known = await asyncio.to_thread(known_tables, store)
            chain = await asyncio.to_thread(store.pushes.chain, site.name, site.urls.control)
            now = await _look_or_strange(session.controller, known, chain, corrects)
        # Read the journal after the controller: a push that ended in between is then already in the journal.
        wanted, settled = (await asyncio.to_thread(JournalView.read, store, site.name, site.urls.control, origins=False)).wanted
        push = now.unverified
        whose = "" if push is None else f"push {push.push} of machine {push.machine!r}"
        return InForce(now.status.active_bank, now.crc, wanted, settled, whose, now.strange or now.elsewhere is not None)

    return look


async def _look_or_strange(controller: TableController, known: KnownTables, chain: str, corrects: dict[int, bool]) -> InForceNow:
    """Identify the table as `table_gate` does. A table whose bytes do not match the stated CRC is strange."""
    try:
        return await table_gate.identify_table(controller, known, chain, corrects)
    except TableMismatch:
        return InForceNow(await controller.comp_status(), None, True, None)


log = structlog.get_logger("abbe.table")

LOOK_S = 10.0
AGAIN_S = 1.0
"""Time after which a first difference is checked again, s: another process's push may have ended between two readings."""
CODE = STRANGE_TABLE_CODE
REMEDY = "find out who wrote it; restore the right table, or have this one accepted if it is right (abbe accept-table -m MACHINE.toml)"
"""Remedy for an unknown table. Rollback and push are refused while the table is active (`abbe.service.tables.table_gate`)."""


class TableWatch:
    """Looks at the table in force while no job has the machine.

    Parameters
    ----------
    look : LookAtTable
        One look; raises errors of devices and store.
    alarms : AlarmSink
        Gets each unknown table once.
    attention : list of str
        Texts on the page until the table is known.
    changed : callable
        Called when ``attention`` has changed.
    """

    def __init__(
        self, look: LookAtTable, alarms: AlarmSink, attention: MutableSequence[str], clock: Clock, changed: Callable[[], None]
    ) -> None:
        self._look, self._alarms, self._attention = look, alarms, attention
        self._clock, self._changed = clock, changed
        self._first: int | None = None
        """CRC expected while the journal states none: the CRC of the first table found without a problem."""
        self._reported: tuple[int, str] | None = None

    async def run(self) -> None:
        """Watch forever. A controller that does not answer is no fault of its table; other parts report the silence."""
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
        """Return the fault of the table in force; empty without a fault."""
        wanted = in_force.wanted if in_force.wanted is not None else self._first
        here = f"bank {in_force.bank} has CRC {in_force.crc:08X}"
        whose = f"it is the table of {in_force.unverified}, which was never verified" if in_force.unverified else ""
        if wanted is not None and in_force.crc != wanted:
            text = f"the compensation in force was changed from outside: {here} instead of {wanted:08X}"
            return f"{text}; {whose}" if whose else text
        if whose:
            return f"the compensation in force is unverified: {here}; {whose}"
        return f"{STRANGE_TABLE} is in force: {here}" if in_force.strange else ""

    async def _judge(self, in_force: InForce) -> None:
        text = self._problem(in_force)
        if not text:
            self._show(None)
            return
        if self._reported is not None and self._reported[0] == in_force.crc:
            return
        log.error("the table in force is not one that Abbe verified", bank=in_force.bank, crc=f"{in_force.crc:08X}", why=text)
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
