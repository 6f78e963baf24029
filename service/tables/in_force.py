"""Which table a controller should have in force, as the push journals tell it: what somebody else has put there is seen against that.

The look is the one of the gate (`abbe.service.tables.table_gate`): what is refused before motion is what the service alarms.
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
    """One look at a controller, and what its journal says.

    Parameters
    ----------
    bank, crc : int
        The active bank and the CRC-32 of its content.
    wanted : int or None
        CRC of the table that was kept or accepted last, else of the one that the first push found; None: not known.
    settled : bool
        False: a push is on its way, or a person has to look at one; comparing says nothing.
    unverified : str
        Which push brought it, where nothing has verified it; else empty.
    strange : bool
        It corrects something, or cannot be read, and no journal of the database has it, or only those of other controls.
    """

    bank: int
    crc: int
    wanted: int | None
    settled: bool = True
    unverified: str = ""
    strange: bool = False


LookAtTable = Callable[[], Awaitable[InForce]]


def look_at_table(site: Site, store: Store) -> LookAtTable:
    """Return how to look. It reads registers only; it is refused (`UnsafeToMove`) while a job of any process has the machine."""

    corrects: dict[int, bool] = {}  # what was read of tables that no journal has: the same bytes are not read every ten seconds

    async def look() -> InForce:
        with lock_machine(site.urls.cnc):
            pass  # not held, as for preconditions: who comes to measure is not turned away by somebody who only looks
        async with open_session(DeviceUrls(cnc=site.urls.cnc)) as session:
            known = await asyncio.to_thread(known_tables, store)
            chain = await asyncio.to_thread(store.pushes.chain, site.name, site.control)
            now = await _look_or_strange(session.controller, known, chain, corrects)
        # After the controller: a push that ended in between is known to the journal before it can be missed here.
        wanted, settled = (await asyncio.to_thread(JournalView.read, store, site.name, site.control, origins=False)).wanted
        push = now.unverified
        whose = "" if push is None else f"push {push.push} of machine {push.machine!r}"
        return InForce(now.status.active_bank, now.crc, wanted, settled, whose, now.strange or now.elsewhere is not None)

    return look


async def _look_or_strange(controller: TableController, known: KnownTables, chain: str, corrects: dict[int, bool]) -> InForceNow:
    """The gate's look. A table without the CRC that is stated for it is strange."""
    try:
        return await table_gate.look(controller, known, chain, corrects)
    except TableMismatch:
        return InForceNow(await controller.comp_status(), None, True, None)
