"""Which table a controller should have in force, as the push journal tells it: what somebody else has put there is seen against that."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from service.devices.alone import alone
from service.devices.session import DeviceUrls, open_session
from service.push.book import read_entries
from service.site import Site
from service.storage.store import Store
from service.workflows.push_history import wanted_by


@dataclass(frozen=True, slots=True)
class InForce:
    """One look at a controller, and what its journal says.

    Parameters
    ----------
    bank, crc : int
        The active bank and the CRC-32 of its content.
    wanted : int or None
        CRC of the table that was kept or accepted last, else of the one that the first push found; None: nobody knows.
    settled : bool
        False: a push is on its way, or a person has to look at one; nothing can be told by comparing.
    """

    bank: int
    crc: int
    wanted: int | None
    settled: bool = True


LookAtTable = Callable[[], Awaitable[InForce]]


def look_at_table(site: Site, store: Store) -> LookAtTable:
    """Return how to look. It reads registers only; it is refused (`UnsafeToMove`) while a job of any process has the machine."""

    async def look() -> InForce:
        with alone(site.urls.cnc):
            pass  # not held, as for preconditions: who comes to measure is not turned away by somebody who only looks
        async with open_session(DeviceUrls(cnc=site.urls.cnc)) as session:
            now = await session.controller.comp_status()
        # After the controller: a push that ended in between is known to the journal before it can be missed here.
        wanted, settled = wanted_by(await asyncio.to_thread(read_entries, store, site.name))
        return InForce(now.active_bank, now.bank_crc[now.active_bank], wanted, settled)

    return look
