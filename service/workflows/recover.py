"""After a crash between activation and verification: a table that nobody verified does not stay active (unconfirmed means back).

A function of the last journal entry and of what the controller says (reliability.md 3.2); safe to repeat.
"""

from __future__ import annotations

import asyncio
import secrets

from drivers.api import CompStatus, Controller
from service.errors import TableMismatch, UnsafeToMove
from service.site import Site
from service.storage.owner import Owner
from service.storage.records import Doc, PushRecord
from service.storage.store import Store
from service.workflows.compensate import LEASE_MS

OPEN = ("STAGING", "ACTIVATING", "PROBATION")


async def recover(controller: Controller, store: Store, site: Site) -> str | None:
    """Finish what an interrupted push left behind; returns one sentence about it, None if there was nothing.

    Raises
    ------
    UnsafeToMove
        Another process is in the middle of a push on this machine.
    TableMismatch
        The controller holds a table that the journal does not know: a person must look.
    """
    machine_id = await store.write(store.add_machine, site.name, site.doc)
    pushes = await asyncio.to_thread(store.pushes, machine_id)
    if not pushes or pushes[-1].state not in OPEN:
        return None
    push = pushes[-1]
    owner = Owner(**push.doc["owner"])
    if not owner.is_gone():
        raise UnsafeToMove(f"push {push.id} is under way (process {owner.pid} on {owner.host})", "wait until it has ended")
    status = await controller.comp_status()
    crc = status.bank_crc[status.active_bank]
    if crc == push.doc["base_crc"] and status.active_bank == push.doc["base_bank"]:
        await _close(store, push, "ABORTED", "interrupted before activation")
        return f"push {push.id} was interrupted before its table became active; the old table is in force"
    if crc != push.doc["crc"] or status.active_bank != push.doc["target_bank"]:
        await _close(store, push, "OPERATOR", "the active table is neither the old nor the new one")
        raise TableMismatch(
            f"push {push.id} was interrupted and the active table is neither the old nor the new one", "look at the controller"
        )
    await _back(controller, push.doc, status)
    await _close(store, push, "ROLLED_BACK", "interrupted before verification")
    return f"push {push.id} was interrupted before its table was verified; the old table was made active again"


async def _back(controller: Controller, journal: Doc, status: CompStatus) -> None:
    base = int(journal["base_bank"])
    if status.bank_crc[base] != journal["base_crc"]:
        raise TableMismatch(
            "the previous table is no longer in its bank", "restore it from the push journal by hand before moving the machine"
        )
    owner = secrets.randbits(31) | 1
    await controller.lease(owner, LEASE_MS)
    try:
        await controller.activate(base, expect_crc=int(journal["base_crc"]), expect_gen=status.gen, owner=owner)
    finally:
        await controller.release(owner)


async def _close(store: Store, push: PushRecord, state: str, why: str) -> None:
    await store.write(store.update_push, push.id, state, push.doc | {"why": why})
