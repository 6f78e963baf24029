"""The way back: making the table active again that was active before a push. One place, for every reason there is to go back.

A function of the push journal and of what the controller says (reliability.md 3.2); safe to repeat.
"""

from __future__ import annotations

import asyncio
import secrets
from typing import Literal

from abbe.drivers.api import Controller
from abbe.drivers.errors import DriverError
from abbe.service.errors import TableMismatch
from abbe.service.storage.records import Doc
from abbe.service.storage.store import Store

LEASE_MS = 60_000
BACK_S = 10.0

Ending = Literal["ABORTED", "ROLLED_BACK", "ROLLBACK_PENDING", "OPERATOR"]


async def release_quietly(controller: Controller, owner: int) -> None:
    """Give a lease back; if that fails the lease ends by itself, and the first error is what a person must read."""
    try:
        await controller.release(owner)
    except DriverError:
        return


async def activate_base(controller: Controller, journal: Doc) -> Ending:
    """Make the base table of a push active if its target is, by compare-and-swap on the base table's own CRC.

    Returns
    -------
    "ABORTED" if the base table was active anyway, "ROLLED_BACK" if it was made so.

    Raises
    ------
    TableMismatch
        The active table is neither the old nor the new one, or the old one is no longer in its bank: a person must look.
    DriverError
        The controller refuses (interlock) or does not answer.
    """
    base, target = int(journal["base_bank"]), int(journal["target_bank"])
    now = await controller.comp_status()
    active, crc = now.active_bank, now.bank_crc[now.active_bank]
    if (active, crc) == (base, journal["base_crc"]):
        return "ABORTED"
    if (active, crc) != (target, journal["crc"]):
        raise TableMismatch("the active table is neither the old nor the new one", "look at the controller before moving the machine")
    if now.bank_crc[base] != journal["base_crc"]:
        raise TableMismatch("the previous table is no longer in its bank", "restore it from the push journal before moving the machine")
    owner = secrets.randbits(31) | 1
    await controller.lease(owner, LEASE_MS)
    try:
        await controller.activate(base, expect_crc=int(journal["base_crc"]), expect_gen=now.gen, owner=owner)
    finally:
        await release_quietly(controller, owner)
    return "ROLLED_BACK"


async def take_back(controller: Controller, store: Store, push_id: int, journal: Doc, why: str) -> Ending:
    """Go back and write how that ended into the journal; never raises for what the controller does.

    "ROLLBACK_PENDING": the controller cannot be switched now (interlock, link); every later start tries again first.
    "OPERATOR": the controller holds something that the journal does not know; nothing moves until a person has looked.
    """
    detail = ""
    try:
        async with asyncio.timeout(BACK_S):
            ending = await activate_base(controller, journal)
    except TableMismatch as error:
        ending, detail = "OPERATOR", str(error)
    except (DriverError, TimeoutError) as error:
        ending, detail = "ROLLBACK_PENDING", str(error) or "no answer"
    await store.write(store.update_push, push_id, ending, journal | {"why": why} | ({"detail": detail} if detail else {}))
    return ending
