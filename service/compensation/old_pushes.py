"""Pushes that stand open in the journal of before decision 0017: their rows are finished once, and none are written any more."""

from __future__ import annotations

import asyncio

from abbe.drivers.api import Controller
from abbe.drivers.links.shielded import run_to_end
from abbe.service.compensation.takeback import take_back
from abbe.service.errors import MachineInUse, StillActive, TableMismatch
from abbe.service.site import Site
from abbe.service.storage.owner import Owner
from abbe.service.storage.store import Store

OPEN = ("STAGING", "ACTIVATING", "PROBATION")
UNFINISHED = (*OPEN, "ROLLBACK_PENDING", "OPERATOR")


async def finish_old_push(controller: Controller, store: Store, site: Site, *, accepted: bool = False) -> str | None:
    """Finish the last row of the old journal, if it is open; returns what was done, or None.

    Parameters
    ----------
    accepted : bool
        A person vouches for the table that is active now.

    Raises
    ------
    MachineInUse
        Its process is still at it.
    StillActive
        The unverified table is still active, because the controller refuses or does not answer.
    TableMismatch
        The controller holds a table that the journal does not know.
    """
    machine_id = await store.write(store.add_machine, site.name, site.doc)
    push = next(iter((await asyncio.to_thread(store.pushes, machine_id))[-1:]), None)
    if push is None or push.state not in UNFINISHED:
        return None
    if push.state in OPEN and not Owner(**push.doc["owner"]).is_gone():
        raise MachineInUse(f"push {push.id} is under way (process {push.doc['owner']['pid']})", "wait until it has ended")
    if accepted:
        now = await controller.comp_status()
        doc = push.doc | {"accepted_bank": now.active_bank, "accepted_crc": now.bank_crc[now.active_bank]}
        await store.write(store.update_push, push.id, "ACCEPTED", doc)
        return f"push {push.id} was accepted"
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
