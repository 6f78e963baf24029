"""Compare the table in force in a controller with the one its push journal expects, to detect tables written by others.

The check is that of the gate (`abbe.service.tables.table_gate`): the service raises an alarm for exactly what the gate refuses before
motion.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from abbe.drivers.api import TableController
from abbe.service.devices.machine_lock import lock_machine
from abbe.service.devices.session import DeviceUrls, open_session
from abbe.service.errors import TableMismatch
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables import table_gate
from abbe.service.tables.push_journal import JournalView
from abbe.service.tables.table_gate import InForceNow
from abbe.service.tables.unverified import KnownTables, known_tables


@dataclass(frozen=True, slots=True)
class InForce:
    """The table in force at one time, and what the journal expects.

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
        The table corrects something or cannot be read, and no journal of this control knows it.
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
            chain = await asyncio.to_thread(store.pushes.chain, site.name, site.control)
            now = await _look_or_strange(session.controller, known, chain, corrects)
        # Read the journal after the controller: a push that ended in between is then already in the journal.
        wanted, settled = (await asyncio.to_thread(JournalView.read, store, site.name, site.control, origins=False)).wanted
        push = now.unverified
        whose = "" if push is None else f"push {push.push} of machine {push.machine!r}"
        return InForce(now.status.active_bank, now.crc, wanted, settled, whose, now.strange or now.elsewhere is not None)

    return look


async def _look_or_strange(controller: TableController, known: KnownTables, chain: str, corrects: dict[int, bool]) -> InForceNow:
    """Check as the gate does. A table whose bytes do not match the stated CRC is strange."""
    try:
        return await table_gate.identify_table(controller, known, chain, corrects)
    except TableMismatch:
        return InForceNow(await controller.comp_status(), None, True, None)
