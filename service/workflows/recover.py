"""Before anything moves: finish what an interrupted push left behind. An unverified table does not stay active (unconfirmed means back)."""

from __future__ import annotations

import asyncio

from drivers.api import Controller
from drivers.errors import DriverError
from drivers.links.shielded import run_to_end
from service.capture.recovery import recover_segments
from service.clock import Clock, SystemClock
from service.errors import AbbeError, MachineInUse, StillActive, TableMismatch
from service.push import conduct
from service.push.adapter import ControllerPort, nobody
from service.push.book import StoreBook, read_entries
from service.push.entries import Journal, facts
from service.push.staging import LAID_ASIDE
from service.push.states import TERMINAL, State
from service.site import Site
from service.storage.owner import Owner, this_process
from service.storage.store import Store
from service.workflows.old_pushes import finish_old_push
from service.workflows.push_history import operator_needed
from service.workflows.pushing import pushes_here
from service.workflows.unverified import unverified_crcs

LOOK = "look at the controller; if its table is right, say so with `abbe accept-table MACHINE.toml`"
READY = "make the machine ready (interlocks, link), then start again"


async def recover(controller: Controller, store: Store, site: Site) -> str | None:
    """Finish what the last push left open, and take over what interrupted runs left; returns what was done in a sentence or two, or None.

    Raises
    ------
    MachineInUse
        Another process is in the middle of a push on this machine.
    StillActive
        The unverified table is still active, because the controller refuses or does not answer.
    TableMismatch
        The controller holds a table that the journal does not know: a person must look (`abbe accept-table`).
    StoreError, CaptureFault
        The database does not take what interrupted runs left, or their folder cannot be used. A single bad segment is only told.
    """
    # First: whatever is wrong with a segment, no unverified table stays active.
    pushed = [await finish_old_push(controller, store, site), await finish_push(controller, store, site)]
    runs = await asyncio.to_thread(recover_segments, store, site.capture)
    return "; ".join([*filter(None, pushed), *(run.text for run in runs)]) or None


async def finish_push(controller: Controller, store: Store, site: Site, clock: Clock | None = None) -> str | None:
    """Bring the last push of this machine to its end, from its journal and from what the controller says.

    Returns
    -------
    str or None
        What was done; None if there was nothing to do.

    Raises
    ------
    MachineInUse, StillActive, TableMismatch
        As of `recover`.
    """
    clock = clock or SystemClock()
    book = await StoreBook.last(store, site.name, clock)
    if book is None:
        return None
    journal = await book.entries()
    before = journal[-1].state
    if before is State.OPERATOR:
        raise operator_needed(journal)
    _refuse_if_under_way(store, site, journal)
    ended = await run_to_end(conduct.recover(ControllerPort(controller, nobody(), clock), book))
    told = _told(ended, before)
    try:
        await _refuse_unverified(controller, store, site)
    except (AbbeError, DriverError) as error:
        if told:
            error.add_note(told)
        raise
    return told


async def _refuse_unverified(controller: Controller, store: Store, site: Site) -> None:
    """Whoever made a table the active one that no push has kept: nothing is measured or written on it."""
    unverified = unverified_crcs(await asyncio.to_thread(read_entries, store, site.name))
    now = await controller.comp_status()
    crc = now.bank_crc[now.active_bank]
    if crc in unverified:
        raise TableMismatch(f"the table in force (CRC {crc:08X}) is that of push {unverified[crc]}, which was never verified", LOOK)


def _told(ended: conduct.Ended, before: State) -> str | None:
    known, number = facts(ended.journal), ended.journal[-1].push
    why = known.get("why", "interrupted before verification")
    match ended.state:
        case state if state is before and state in TERMINAL:
            return None
        case State.ROLLED_BACK:
            return f"push {number} was not verified ({why}); the old table was made active again"
        case State.ABORTED:
            return f"push {number} was not finished ({why}); the old table is in force"
        case State.OPERATOR:
            raise operator_needed(ended.journal)
    raise StillActive(f"the unverified table of push {number} is still active: {known.get('pending', ended.why)}", READY)


async def accept(controller: Controller, store: Store, site: Site) -> str:
    """A person vouches for the table that is active now: the last push is closed. Returns what was done.

    An interrupted push that can be finished is finished instead, and nothing is accepted: the person has looked at another table then.

    Raises
    ------
    MachineInUse
        Another process is in the middle of a push on this machine.
    """
    clock = SystemClock()
    await finish_old_push(controller, store, site, accepted=True)
    book = await StoreBook.last(store, site.name, clock)
    journal: Journal = () if book is None else await book.entries()
    if book is not None and journal[-1].state not in TERMINAL:
        _refuse_if_under_way(store, site, journal)
        before = await controller.comp_status()
        ended = await run_to_end(conduct.recover(ControllerPort(controller, nobody(), clock), book))
        journal, now = ended.journal, await controller.comp_status()
        if ended.settled and journal[-1].state is not State.OPERATOR:
            changed = before.active_bank != now.active_bank
            what = (
                "the table from before it was made active again: look at the controller once more" if changed else "its table is as it was"
            )
            return f"push {journal[-1].push} was interrupted and is finished now ({journal[-1].state}); {what}; nothing was accepted"
    return await _accepted(controller, book, journal)


async def _accepted(controller: Controller, book: StoreBook | None, journal: Journal) -> str:
    now = await controller.comp_status()
    crc, other = now.bank_crc[now.active_bank], 1 - now.active_bank
    if now.bank_state[other] == LAID_ASIDE and now.bank_crc[other] != crc:
        raise TableMismatch(
            f"the control has another table laid aside (bank {other}, CRC {now.bank_crc[other]:08X}) and uses it after its next start",
            "take that one away at the control first; nothing was accepted",
        )
    told = f"the active table (bank {now.active_bank}, CRC {crc:08X}) is accepted"
    if book is None:
        return told
    known = facts(journal)
    if journal[-1].state not in TERMINAL:
        journal = (*journal, await book.append(journal, State.OPERATOR, {"why": "a person took the decision"}))
    unverified = crc == known["crc"] and journal[-1].state is not State.KEEP
    await book.append(journal, State.ACCEPTED, {"accepted_bank": now.active_bank, "accepted_crc": crc})
    return told + (f"; it is that of push {journal[-1].push}, which no measurement has verified" if unverified else "")


def _refuse_if_under_way(store: Store, site: Site, journal: Journal) -> None:
    """A push that another process, or another task of this one, is driving is not recovered by us."""
    last = journal[-1]
    if last.state in TERMINAL or last.state is State.ROLLBACK_PENDING:
        return
    process = facts(journal).get("process")
    owner = Owner(**process) if process else None
    ours = owner == this_process()
    if owner is not None and (pushes_here(store, site.name) if ours else not owner.is_gone()):
        raise MachineInUse(f"push {last.push} is under way (process {owner.pid})", "wait until it has ended")
