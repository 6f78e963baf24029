"""Before anything moves: finish what an interrupted push left behind. An unverified table does not stay active (unconfirmed means back)."""

from __future__ import annotations

import asyncio

from drivers.api import Controller
from drivers.links.shielded import run_to_end
from service.errors import StillActive, TableMismatch, UnsafeToMove
from service.site import Site
from service.storage.owner import Owner
from service.storage.records import PushRecord
from service.storage.store import Store
from service.workflows.takeback import take_back

OPEN = ("STAGING", "ACTIVATING", "PROBATION")
ACCEPTED = "ACCEPTED"


async def recover(controller: Controller, store: Store, site: Site) -> str | None:
    """Finish what the last push left open; returns one sentence about it, None if there was nothing.

    Raises
    ------
    UnsafeToMove
        Another process is in the middle of a push on this machine.
    StillActive
        The unverified table is still active, because the controller refuses or does not answer.
    TableMismatch
        The controller holds a table that the journal does not know: a person must look (`abbe accept-table`).
    """
    push = await _last_push(store, site)
    if push is None or push.state not in (*OPEN, "ROLLBACK_PENDING", "OPERATOR"):
        return None
    _refuse_if_under_way(push)
    why = str(push.doc.get("why", "interrupted before verification"))
    ending = await run_to_end(take_back(controller, store, push.id, push.doc, why))
    if ending == "ROLLED_BACK":
        return f"push {push.id} was not verified ({why}); the old table was made active again"
    if ending == "ABORTED":
        return f"push {push.id} was not finished ({why}); the old table is in force"
    if ending == "ROLLBACK_PENDING":
        raise StillActive(
            f"the unverified table of push {push.id} is still active", "make the machine ready (interlocks, link), then start again"
        )
    raise TableMismatch(
        f"push {push.id}: the active table is neither the old nor the new one, or the old one is gone",
        "look at the controller; if its table is right, say so with `abbe accept-table MACHINE.toml`",
    )


async def accept(controller: Controller, store: Store, site: Site) -> str:
    """A person vouches for the table that is active now: the last push is closed. Returns one sentence.

    Raises
    ------
    UnsafeToMove
        Another process is in the middle of a push on this machine.
    """
    push = await _last_push(store, site)
    _refuse_if_under_way(push)
    now = await controller.comp_status()
    crc = now.bank_crc[now.active_bank]
    if push is not None and push.state in (*OPEN, "ROLLBACK_PENDING", "OPERATOR"):
        doc = push.doc | {"accepted_bank": now.active_bank, "accepted_crc": crc}
        await store.write(store.update_push, push.id, ACCEPTED, doc)
    return f"the active table (bank {now.active_bank}, CRC {crc:08X}) is accepted"


def _refuse_if_under_way(push: PushRecord | None) -> None:
    if push is not None and push.state in OPEN and not Owner(**push.doc["owner"]).is_gone():
        raise UnsafeToMove(f"push {push.id} is under way (process {push.doc['owner']['pid']})", "wait until it has ended")


async def _last_push(store: Store, site: Site) -> PushRecord | None:
    machine_id = await store.write(store.add_machine, site.name, site.doc)
    pushes = await asyncio.to_thread(store.pushes, machine_id)
    return pushes[-1] if pushes else None
