"""Recovery before anything moves: finish an interrupted push. An unverified table does not stay active (unconfirmed means rollback).

`recovered_session` opens the controller, recovers, and only then opens the instruments, because a missing or silent instrument must not
keep an unverified table in force (tests/service/devices/test_every_session.py). `finish_when_safe` waits until the machine is safe and then
rolls back at once.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace

from abbe.drivers.api import BankState, Controller, Identity, TableController, only_listens
from abbe.drivers.errors import DriverError, run_to_end
from abbe.service.capture.recovery import recover_segments
from abbe.service.clock import Clock, SystemClock
from abbe.service.compensation.pushing import pushes_here
from abbe.service.devices.session import Ask, DeviceUrls, Session, no_console, open_session
from abbe.service.domain.measured import Owner, this_process
from abbe.service.domain.push_entry import BEFORE_ACTIVATION, TERMINAL, PushState
from abbe.service.errors import AbbeError, MachineInUse, StillActive, TableMismatch
from abbe.service.push import execute
from abbe.service.push.execute import ControllerPort, no_actors
from abbe.service.push.journal import NO_PUSH, Journal, StoreBook, facts
from abbe.service.push.operations import Done, Operation, OperationKind, Outcome, Truth, Unanswered
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.known_tables import KnownTables, known_tables
from abbe.service.tables.push_journal import operator_needed
from abbe.service.tables.table_gate import accept_strange, acceptance_doc, check_in_force, vouch

READY = "make the machine ready (interlocks, link), then start again"


async def recover(controller: TableController, store: Store, site: Site, *, accept_by: str = "") -> str | None:
    """Finish the last push and store the samples that interrupted runs left on disk; return what was done, or None.

    Everything that moves the machine, or relies on its table, calls this first (tests/service/devices/test_every_session.py).

    Parameters
    ----------
    accept_by : str
        Person who vouches for a table in force that this database did not push; empty: none.

    Raises
    ------
    MachineInUse
        Another process is pushing on this machine.
    StillActive
        The unverified table is still active, because the controller refuses or does not answer.
    TableMismatch
        The controller holds an unverified table, under whatever machine name it was pushed, or a table that this database did not push: a
        person must look (`abbe accept-table`).
    StoreError, CaptureFault
        The database refuses the samples of interrupted runs, or their folder cannot be used. A single bad segment is only reported.
    """
    await store.write(store.machines.add, site.name, site.doc)  # the present description of the machine
    # The push comes first: a damaged segment must not keep an unverified table active.
    pushed = await finish_push(controller, store, site, accept_by=accept_by)
    runs = await asyncio.to_thread(recover_segments, store, site.capture)
    return "; ".join([*([pushed] if pushed else []), *(run.text for run in runs)]) or None


async def finish_push(
    controller: TableController, store: Store, site: Site, clock: Clock | None = None, *, accept_by: str = ""
) -> str | None:
    """Finish the last push into this machine's control, from its journal and the controller's state; then check the table in force
    (`check_in_force`).

    Returns
    -------
    str or None
        Summary of the actions; None if there was nothing to do.

    Raises
    ------
    MachineInUse, StillActive, TableMismatch
        As for `recover`.
    """
    done = await _finish_last(controller, store, site, clock or SystemClock())
    if only_listens(controller) and not accept_by:  # it shows no table that could be another than ours
        return done
    try:
        accepted = await accept_strange(controller, store, site, accept_by) if accept_by else None
        await check_in_force(controller, store, site)
    except (AbbeError, DriverError) as error:
        if done:
            error.add_note(done)
        raise
    return "; ".join(filter(None, (done, accepted))) or None


async def _finish_last(controller: TableController, store: Store, site: Site, clock: Clock) -> str | None:
    """Finish the last push without checking the table in force; return what was done."""
    book = await StoreBook.last(store, site.name, clock, site.urls.control)
    journal: Journal = () if book is None else await book.entries()
    if book is None or journal[-1].push == NO_PUSH:
        return None
    before = journal[-1].state
    if before not in TERMINAL or before is PushState.OPERATOR:
        await check_own(controller, site, journal)
    if before is PushState.OPERATOR:
        raise operator_needed(journal)
    _refuse_if_under_way(store, site, journal)
    ended = await run_to_end(execute.recover(ControllerPort(controller, no_actors(), clock), book))
    return _summary(ended, before)


def _summary(ended: execute.Ended, before: PushState) -> str | None:
    known, number = facts(ended.journal), ended.journal[-1].push
    why = known.why or "interrupted before verification"
    match ended.state:
        case state if state is before and state in TERMINAL:
            return None
        case PushState.ROLLED_BACK:
            return f"push {number} was not verified ({why}); the old table was made active again"
        case PushState.ABORTED:
            return f"push {number} was not finished ({why}); the old table is in force"
        case PushState.OPERATOR:
            raise operator_needed(ended.journal)
    raise StillActive(f"the unverified table of push {number} is still active: {known.pending or ended.why}", READY)


async def accept(controller: TableController, store: Store, site: Site, by: str = "a person") -> str:
    """Record that a person vouches for the active table, and close every open push of it, whatever machine name it was begun under.

    If an interrupted push can be finished, it is finished and nothing is accepted, since the table in force may then not be the one that
    the person saw. ``by`` is kept in the journal. Returns what was done.

    Raises
    ------
    MachineInUse
        Another process is pushing on this machine.
    """
    clock = SystemClock()
    await store.write(store.machines.add, site.name, site.doc)
    book = await StoreBook.last(store, site.name, clock, site.urls.control)
    journal: Journal = () if book is None else await book.entries()
    if book is not None and journal[-1].state not in TERMINAL and await is_own(controller, site, journal):
        _refuse_if_under_way(store, site, journal)
        before = await controller.comp_status()
        ended = await run_to_end(execute.recover(ControllerPort(controller, no_actors(), clock), book))
        journal, now = ended.journal, await controller.comp_status()
        if ended.settled and journal[-1].state is not PushState.OPERATOR:
            changed = before.active_bank != now.active_bank
            what = (
                "the table from before the push is active again: look at the controller once more"
                if changed
                else "the active table is unchanged"
            )
            return f"push {journal[-1].push} was interrupted and is finished now ({journal[-1].state}); {what}; nothing was accepted"
    return await _accepted(controller, store, site, by)


async def _accepted(controller: TableController, store: Store, site: Site, by: str) -> str:
    now = await controller.comp_status()
    crc, other = now.bank_crc[now.active_bank], 1 - now.active_bank
    if now.bank_state[other] is BankState.LAID_ASIDE and now.bank_crc[other] != crc:
        raise TableMismatch(
            f"the control has another table laid aside (bank {other}, CRC {now.bank_crc[other]:08X}) and uses it after its next start",
            "remove the laid-aside table at the control first; nothing was accepted",
        )
    known = await asyncio.to_thread(known_tables, store)
    chain = await asyncio.to_thread(store.pushes.chain, site.name, site.urls.control)
    await _hand_to_person(store, site, chain)
    for other_chain in _open_with(crc, known) - {chain}:
        book = await _hand_to_person(store, site, other_chain)
        await book.append(await book.entries(), PushState.ACCEPTED, acceptance_doc(now, by))
    await vouch(store, site, now, by)
    text = f"the active table (bank {now.active_bank}, CRC {crc:08X}) is accepted by {by}"
    push = known.unverified.get(crc)
    if push is None:
        return text
    name = "" if push.chain == chain and push.machine == site.name else f" of machine {push.machine!r}"
    return f"{text}; it is the table of push {push.push}{name}, which no measurement has verified"


def _open_with(crc: int, known: KnownTables) -> set[str]:
    """Return the journal in which the last push of this table is open, if any: recovery under another name would roll the table back."""
    push = known.pushed.get(crc)
    return {push.chain} if push is not None and push.may_be_active else set()


async def _hand_to_person(store: Store, site: Site, chain: str) -> StoreBook:
    """Close the last push of a journal, if it is open, so that a person can decide; return the journal."""
    book = await StoreBook.of_chain(store, chain, SystemClock()) or await StoreBook.for_acceptance(
        store, site.name, SystemClock(), site.urls.control
    )
    journal = await book.entries()
    if journal and journal[-1].state not in TERMINAL:
        _refuse_if_under_way(store, site, journal)
        state = PushState.ABORTED if journal[-1].state in BEFORE_ACTIVATION else PushState.OPERATOR
        await book.append(journal, state, {"why": "a person took the decision"})
    return book


def _refuse_if_under_way(store: Store, site: Site, journal: Journal) -> None:
    """Raise MachineInUse if another process, or another task of this process, is driving the push."""
    last = journal[-1]
    if last.state in TERMINAL or last.state is PushState.ROLLBACK_PENDING:
        return
    process = facts(journal).process
    owner = Owner(**process) if process else None
    ours = owner == this_process()
    if owner is not None and (pushes_here(store, site) if ours else not owner.is_gone()):
        raise MachineInUse(f"push {last.push} is under way (process {owner.pid})", "wait until the push has ended")


async def is_own(controller: Identity, site: Site, journal: Journal) -> bool:
    """Whether a push was begun on this control. Proofs: address and name, address and boot id, or the pushed table in force.

    A table carries a random number, so the pushed table in force proves the control. The base table proves nothing: two controls in factory
    state hold the same one. The controller is read only where address and name do not match.
    """
    known = facts(journal)
    here = _address(journal) in ("", site.urls.control)
    if here and _name(journal, site) == site.name:
        return True
    now = await controller.comp_status()
    return (here and now.boot_id == known.boot) or now.bank_crc[now.active_bank] == known.crc


async def check_own(controller: Identity, site: Site, journal: Journal) -> None:
    """Refuse to finish a push if nothing proves that it was begun on this control (`is_own`). Nothing is written.

    Raises
    ------
    TableMismatch
        Names the push, where it was begun, and what a person can do.
    """
    if await is_own(controller, site, journal):
        return
    at, name = _address(journal) or "an address that the journal does not state", _name(journal, site)
    raise TableMismatch(
        f"push {journal[-1].push} of machine {name!r}, begun at {at}, has not ended, and "
        f"nothing shows that this control belongs to machine {name!r}",
        f"finish the push with the machine file of {name!r}; if this control belongs to it and its active table is right: "
        "`abbe accept-table -m MACHINE.toml --yes`; nothing was written",
    )


def _address(journal: Journal) -> str:
    return facts(journal).control


def _name(journal: Journal, site: Site) -> str:
    return facts(journal).machine or site.name


@asynccontextmanager
async def recovered_session(
    store: Store,
    site: Site,
    urls: DeviceUrls | None = None,
    ask: Ask = no_console,
    *,
    accept_by: str = "",
    report: Callable[[str], object] | None = None,
    listening: bool = False,
) -> AsyncIterator[Session]:
    """Open a machine's devices; `recover` runs after the controller is open and before any other device.

    Parameters
    ----------
    urls : DeviceUrls, optional
        Default: all devices of the machine file.
    ask, listening, accept_by
        Passed to `open_session` and `recover`.
    report : callable, optional
        Receives what recovery did, before the other devices are opened.

    Raises
    ------
    AbbeError, DriverError
        From `recover`: no other device was opened. From `open_session`: the interrupted push is finished already.
    """

    async def first(controller: Controller) -> None:
        done = await recover(controller, store, site, accept_by=accept_by)
        if done is not None and report is not None:
            report(done)

    async with open_session(urls or site.urls, ask, first=first, listening=listening) as session:
        yield replace(session, recovered=True)


LIMIT_S = 600.0
"""Default limit of a command's wait, s."""
POLL_S, REMIND_S, RETRY_S = 0.1, 30.0, 2.0
"""Interval of looks at the controller; interval of reminders to a person; pause after the controller has refused a rollback."""

Notify = Callable[[str], None]


async def finish_when_safe(
    controller: TableController, store: Store, site: Site, *, limit_s: float, clock: Clock, notify: Notify
) -> str | None:
    """Wait until the machine is safe and the controller answers, then roll back to the old table at once.

    Nothing is reset and nothing moves: a person makes the machine ready. May be cancelled at any time; the next command tries again
    before anything else.

    Parameters
    ----------
    limit_s : float
        How long to wait, seconds of the clock.
    notify : callable
        Receives a message that an unverified table is active and what blocks the rollback: on every change and every `REMIND_S`.

    Returns
    -------
    str or None
        Summary of the actions; None if there was nothing to do.

    Raises
    ------
    StillActive
        The machine did not become safe within ``limit_s``.
    TableMismatch
        The controller holds a table that is not in the journal: a person must look.
    """
    book = await StoreBook.last(store, site.name, clock, site.urls.control)
    if book is None or (await book.entries())[-1].state in TERMINAL - {PushState.OPERATOR}:
        return None
    port = ControllerPort(controller, no_actors(), clock)
    end_s = clock.monotonic_s() + limit_s
    last_reason, remind_s = "", 0.0
    while True:
        why, pause_s = _blocked_by(await port.execute(Operation(OperationKind.LOOK), ())), POLL_S
        if not why:
            try:
                return await finish_push(controller, store, site, clock)
            except StillActive as error:
                why, pause_s = str(error), RETRY_S
        now_s = clock.monotonic_s()
        if why != last_reason or now_s >= remind_s:
            notify(f"AN UNVERIFIED TABLE IS ACTIVE. Waiting for the machine, {max(end_s - now_s, 0.0):.0f} s more: {why}")
            last_reason, remind_s = why, now_s + REMIND_S
        if now_s >= end_s:
            raise StillActive(f"the unverified table is STILL ACTIVE after {limit_s:.0f} s of waiting: {why}", READY)
        await clock.sleep(min(pause_s, end_s - now_s))


def _blocked_by(look: Outcome) -> str:
    """Return what blocks the rollback, by the last reading of the controller; empty if nothing does."""
    if isinstance(look, Done):
        return look.value.unsafe if isinstance(look.value, Truth) else "no answer"
    # The message of the link counts down: its text would differ, and notify, at every look.
    return "the controller does not answer" if isinstance(look, Unanswered) else look.text


def with_notes(error: BaseException) -> str:
    """Text of an error with its notes, which name the table in force."""
    return "; ".join([str(error), *getattr(error, "__notes__", [])])
