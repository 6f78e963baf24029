"""Bring the previous table back on a person's order: a push of its own, by the same push machine and into the same journal.

No probe and no verification is measured: the journal holds the image, byte for byte, of a table that was in force, verified or put there
by a person. Everything else is as for any push: interlocks, lease, two read-backs, compare-and-swap, and rollback if the push breaks off.

`ordered_rollback` is the order given to the service: it locks the machine and touches only the table that the person saw in force.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field

from abbe.drivers.api import TableController
from abbe.drivers.errors import DriverError
from abbe.drivers.tables import crc32
from abbe.service.audit.book import by_whom
from abbe.service.clock import Clock
from abbe.service.compensation.commission import check_commissioned
from abbe.service.compensation.pushing import Pushing, PushResult, Questions, RestoredTable
from abbe.service.compensation.recover import LIMIT_S, finish_when_safe, recover, with_notes
from abbe.service.devices.session import DeviceUrls, lock_machine, open_session
from abbe.service.domain.progress import JobOutcome
from abbe.service.domain.push_entry import TERMINAL, PushState
from abbe.service.errors import AbbeError, MachineInUse, StillActive, TableMismatch, TableRefused
from abbe.service.push.journal import BY_ROLLBACK, Journal, facts
from abbe.service.push.operations import VerificationResult
from abbe.service.sequences.control import Control
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.known_tables import unverified_crcs
from abbe.service.tables.nine_tables import Base, read_base
from abbe.service.tables.push_journal import KIND, STOPPED, JournalView, ended_as


@dataclass(frozen=True, slots=True)
class KnownTable:
    """The bytes of a table that was once in force, from the journal, and a sentence on when it was in force."""

    image: bytes
    semantic_digest: str
    how: str


@dataclass(frozen=True, slots=True)
class RollbackResult:
    """The push that restored a table, and a sentence that names this table."""

    pushed: PushResult
    how: str


@dataclass(frozen=True, slots=True)
class RollbackRequest:
    """Order of a rollback: person, reason, number, and the control that may stop it. Stored with the table and in the push journal."""

    who: str
    reason: str
    number: str
    control: Control = field(default_factory=Control)


async def rollback(
    controller: TableController, store: Store, site: Site, to: int | None = None, request: RollbackRequest | None = None
) -> RollbackResult | None:
    """Restore a table that was in force before.

    Parameters
    ----------
    to : int, optional
        Restore the table that was in force after this push; 0: before the first push. Default: before the last kept push, whose table
        must be in force now.
    request : RollbackRequest, optional
        Default: the account on this computer orders it.

    Returns
    -------
    RollbackResult or None
        None: that table is in force already; nothing was written.

    Raises
    ------
    TableRefused
        The journal holds no such table, or the push that restores it was rolled back.
    TableMismatch
        The table in force is not in the journal: a person must look first.
    StoreError
        The journal was changed after it was written.
    PushNotBegun, StillActive
        From `Pushing.bring`.
    """
    await recover(controller, store, site)
    journal = await asyncio.to_thread(JournalView.read, store, site.name, site.urls.control)
    if not journal.entries:
        raise TableRefused("no push of this machine is in the journal: there is nothing to roll back", "nothing was written")
    base = await read_base(controller)
    check_known(journal, base)
    wanted = table_after(journal, to) if to is not None else table_before_last_kept(journal, base)
    if wanted.image == base.image:
        return None
    await check_commissioned(controller, store, site)  # the image was proved on one control: what another one does with it is unknown
    why = f"a person ordered the rollback, nothing was measured: byte for byte {wanted.how}"

    def reasons() -> list[str]:
        return [] if wanted.image in known_images(journal) else ["UNKNOWN: by the journal, this table was never in force"]

    async def in_force_before() -> VerificationResult:
        return VerificationResult(not reasons(), why)

    by = by_whom() if request is None else request.who
    questions = Questions(reasons, f"{by}{BY_ROLLBACK}", in_force_before, in_force_before)
    doc = {"kind": KIND, "to": to, "how": wanted.how, "by": by}
    if request is not None:
        doc |= {"reason": request.reason, "order": request.number}
    pushing = Pushing(controller, store, site, control=Control() if request is None else request.control)
    pushed = await pushing.bring(RestoredTable(wanted.image, wanted.semantic_digest, base, doc), questions)
    if not pushed.kept:
        raise TableRefused(f"the rollback failed: {pushed.why}", "the previous table stays in force; remove the cause, then try again")
    return RollbackResult(pushed, wanted.how)


def _base(journal: Journal, how: str) -> KnownTable:
    f = facts(journal)
    return KnownTable(f.base_image, f.base_semantic_digest, how)


def _left(journal: Journal) -> KnownTable:
    """The table that was in force after a push."""
    state, number, f = ended_as(journal), journal[-1].push, facts(journal)
    if state is PushState.KEEP:
        return KnownTable(f.image, f.semantic_digest, f"the table that push {number} brought and kept")
    if state in TERMINAL - {PushState.OPERATOR, PushState.ACCEPTED}:
        return _base(journal, f"the table that was in force before and after push {number}")
    raise TableRefused(f"push {number} ended {state}: the journal does not hold the table that was in force then", "name another push")


def known_images(journal: JournalView) -> set[bytes]:
    """Images of all tables that were in force, verified or put there by a person: bases and kept tables."""
    found, refuted = set(), unverified_crcs(journal.entries)
    for push in journal.pushes.values():
        f = facts(push)
        if f.base_crc not in refuted:
            found.add(f.base_image)
        if ended_as(push) is PushState.KEEP:
            found.add(f.image)
    return found


def check_known(journal: JournalView, base: Base) -> None:
    """Refuse to overwrite a table written by a person or another program, until a person has checked it.

    Raises
    ------
    TableMismatch
        The table in force is neither known nor accepted by a person.
    """
    accepted = {facts((e,)).accepted_crc for e in journal.entries if e.state is PushState.ACCEPTED}
    if base.image not in known_images(journal) and crc32(base.image) not in accepted:
        raise TableMismatch(
            f"the table in force ({base.crc:08X}) is not in the push journal",
            "look at the controller; nothing was written",
        )


def table_after(journal: JournalView, push: int) -> KnownTable:
    """The table that was in force after a push; 0: before the first push. Raises TableRefused."""
    journals = journal.pushes
    if push == 0 and journals:
        return _base(next(iter(journals.values())), "the table that was in force before the first push")
    if push not in journals:
        raise TableRefused(f"there is no push {push} of this machine", "abbe comp show lists what was pushed; nothing was written")
    return _left(journals[push])


def table_before_last_kept(journal: JournalView, base: Base) -> KnownTable:
    """The table before the last kept push. Raises TableRefused if that push was a rollback, or if its table is not in force."""
    last = journal.last_kept()
    f, number = facts(last), last[-1].push
    if f.image != base.image:
        raise TableRefused(
            f"the table in force is not the table of push {number}", "name the push to go back to with --to PUSH; nothing was written"
        )
    return _base(last, f"the table that was in force before push {number}")


@dataclass(frozen=True, slots=True)
class RollbackOrder:
    """An order to replace the table of push ``push``, which is in force and has this CRC, by the table before it."""

    push: int
    crc: int
    request: RollbackRequest


async def ordered_rollback(site: Site, store: Store, order: RollbackOrder, *, clock: Clock) -> JobOutcome:
    """Roll back. The outcome reports this attempt; the journal decides which table is in force (`JournalView.of_order`).

    A refusal is an outcome, not an error: another process has the machine, the controller holds a table unknown to the journal, or the
    journal moved on after the order was given.
    """
    try:
        with lock_machine(site.urls.cnc):
            async with open_session(DeviceUrls(cnc=site.urls.cnc)) as session:
                return await _attempt(session.controller, store, site, order, clock)
    except MachineInUse as busy:
        return JobOutcome("refused", f"{busy}; nothing was written")
    except (AbbeError, DriverError, OSError) as error:
        return JobOutcome("failed", with_notes(error))


async def _attempt(controller: TableController, store: Store, site: Site, order: RollbackOrder, clock: Clock) -> JobOutcome:
    control = order.request.control
    try:
        await asyncio.to_thread(check_unchanged, store, site.name, order, site.urls.control)
        back = await rollback(controller, store, site, request=order.request)
    except (TableRefused, TableMismatch) as no:
        return JobOutcome("refused", with_notes(no))
    except StillActive as open_:
        return await _finish_when_safe(controller, store, site, order, open_, clock)
    except MachineInUse:
        raise
    except (AbbeError, DriverError, OSError) as error:
        return JobOutcome(STOPPED if control.stopping or control.aborting else "failed", with_notes(error))
    if back is None:
        return JobOutcome("refused", "the earlier table is in force already; nothing was written")
    text = f"push {back.pushed.push_id}: the table is in force again (CRC {back.pushed.crc:08X}): {back.how}"
    return JobOutcome("kept", f"{text}; the machine is unverified now: run a quick check")


def check_unchanged(store: Store, machine: str, order: RollbackOrder, control: str = "") -> None:
    """Refuse an order if, by the journal, the table that it replaces is not in force.

    Raises
    ------
    TableRefused
        The tables differ, or there is nothing left to roll back.
    """
    now = JournalView.read(store, machine, control).offer()
    if (now.push, now.crc) != (order.push, order.crc):
        raise TableRefused(
            f"the table in force is {now.crc:08X} of push {now.push}, but the order was to roll back {order.crc:08X} of push {order.push}",
            "look at the table in force again; nothing was written",
        )


async def _finish_when_safe(
    controller: TableController, store: Store, site: Site, order: RollbackOrder, error: StillActive, clock: Clock
) -> JobOutcome:
    """Finish an interrupted rollback as soon as the machine is safe."""
    finish = finish_when_safe(controller, store, site, limit_s=LIMIT_S, clock=clock, notify=lambda _: None)
    try:
        done = await order.request.control.unless_stopped(finish)
    except (AbbeError, DriverError, OSError) as again:
        return JobOutcome("failed", f"{with_notes(error)}; {with_notes(again)}; the rollback runs before the next check")
    return JobOutcome("rolled back", f"{with_notes(error)}; {done or 'nothing was left to roll back'}")
