"""A person orders the table back that was in force before: a push of its own, through the same machine, into the same journal.

No probe and no verification is measured, because there is nothing to find out: the image is byte for byte one that the journal knows to
have been in force, verified or put there by a person. Everything else is as for any push: interlocks, lease, read-back twice,
compare-and-swap, and the way back if it breaks off.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field

from abbe.drivers.api import TableController
from abbe.drivers.tables import crc32
from abbe.service.compensation.commission import check_commissioned
from abbe.service.compensation.proposals import by_whom
from abbe.service.compensation.pushing import Pushing, PushResult, Questions, WantedAgain
from abbe.service.compensation.recover import recover
from abbe.service.errors import TableMismatch, TableRefused
from abbe.service.push.entries import Journal, facts
from abbe.service.push.operations import Verdict
from abbe.service.push.states import TERMINAL, PushState
from abbe.service.sequences.control import Control
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.base_table import Base, read_base
from abbe.service.tables.push_journal import KIND, JournalView, ended_as
from abbe.service.tables.unverified import unverified_crcs


@dataclass(frozen=True, slots=True)
class KnownTables:
    """A table that was in force, as the journal holds it in full, and how the journal knows it."""

    image: bytes
    meaning: str
    how: str


@dataclass(frozen=True, slots=True)
class Back:
    """The push that brought a table back, and which table that is."""

    pushed: PushResult
    how: str


@dataclass(frozen=True, slots=True)
class Ordered:
    """Who orders a table back, why, under which number of the order, and who may stop it. Kept with the table and in its journal."""

    who: str
    reason: str
    number: str
    control: Control = field(default_factory=Control)


async def rollback(
    controller: TableController, store: Store, site: Site, to: int | None = None, ordered: Ordered | None = None
) -> Back | None:
    """Make a table active again that was in force before.

    Parameters
    ----------
    to : int, optional
        The table that was in force when this push had ended; 0: before the first push. Default: before the last kept push, which must have
        brought the table that is in force now.
    ordered : Ordered, optional
        Who orders it. Default: the account on this computer.

    Returns
    -------
    Back or None
        None: that table is in force already, nothing was written.

    Raises
    ------
    TableRefused
        The journal knows no such table.
    TableMismatch
        The table in force is not one that the journal knows: a person must look first.
    StoreError
        The journal is not what was written.
    PushNotBegun, StillActive
        As of any push.
    """
    await recover(controller, store, site)
    journal = await asyncio.to_thread(JournalView.read, store, site.name, site.control)
    if not journal.entries:
        raise TableRefused("no push of this machine is in the journal: there is nothing to take back", "nothing was written")
    base = await read_base(controller)
    check_known(journal, base)
    wanted = table_after(journal, to) if to is not None else table_before_last_kept(journal, base)
    if wanted.image == base.image:
        return None
    await check_commissioned(controller, store, site)  # "was in force" was true of a control: what another one makes of it is not known
    why = f"not measured: byte for byte {wanted.how}; ordered back by a person"

    def reasons() -> list[str]:
        return [] if wanted.image in known_images(journal) else ["UNKNOWN: the journal does not know this table as one that was in force"]

    async def in_force_before() -> Verdict:
        return Verdict(not reasons(), why)

    by = by_whom() if ordered is None else ordered.who
    questions = Questions(reasons, f"{by}: rollback", in_force_before, in_force_before)
    doc = {"kind": KIND, "to": to, "how": wanted.how, "by": by}
    if ordered is not None:
        doc |= {"reason": ordered.reason, "order": ordered.number}
    pushing = Pushing(controller, store, site, control=Control() if ordered is None else ordered.control)
    pushed = await pushing.bring(WantedAgain(wanted.image, wanted.meaning, base, doc), questions)
    if not pushed.kept:
        raise TableRefused(
            f"the table was not brought back: {pushed.why}", "the table from before is in force; look at the cause, then try again"
        )
    return Back(pushed, wanted.how)


def _base(journal: Journal, how: str) -> KnownTables:
    f = facts(journal)
    return KnownTables(f.base_image, f.base_meaning, how)


def _left(journal: Journal) -> KnownTables:
    """What was in force when a push had ended."""
    state, number, f = ended_as(journal), journal[-1].push, facts(journal)
    if state is PushState.KEEP:
        return KnownTables(f.image, f.meaning, f"the table that push {number} brought and kept")
    if state in TERMINAL - {PushState.OPERATOR, PushState.ACCEPTED}:
        return _base(journal, f"the table that was in force before and after push {number}")
    raise TableRefused(f"push {number} ended {state}: the journal does not hold the table that was in force then", "name another")


def known_images(journal: JournalView) -> set[bytes]:
    """All tables that were in force, verified or put there by a person: bases, and what was kept."""
    found, refuted = set(), unverified_crcs(journal.entries)
    for push in journal.pushes.values():
        f = facts(push)
        if f.base_crc not in refuted:
            found.add(f.base_image)
        if ended_as(push) is PushState.KEEP:
            found.add(f.image)
    return found


def check_known(journal: JournalView, base: Base) -> None:
    """What a person or another program put there is never overwritten without a look at it.

    Raises
    ------
    TableMismatch
        The table in force is neither known as one that was in force nor as one that a person accepted.
    """
    accepted = {facts((e,)).accepted_crc for e in journal.entries if e.state is PushState.ACCEPTED}
    if base.image not in known_images(journal) and crc32(base.image) not in accepted:
        raise TableMismatch(
            f"the table in force ({base.crc:08X}) is not one that the push journal knows",
            "look at the controller; nothing was written",
        )


def table_after(journal: JournalView, push: int) -> KnownTables:
    """The table that was in force when a push had ended; 0: before the first."""
    journals = journal.pushes
    if push == 0 and journals:
        return _base(next(iter(journals.values())), "the table that was in force before the first push")
    if push not in journals:
        raise TableRefused(f"there is no push {push} of this machine", "abbe comp show lists what was pushed; nothing was written")
    return _left(journals[push])


def table_before_last_kept(journal: JournalView, base: Base) -> KnownTables:
    """The table before the last kept push, if that one is in force and was no rollback itself."""
    last = journal.last_kept()
    f, number = facts(last), last[-1].push
    if f.image != base.image:
        raise TableRefused(f"the table in force is not the one of push {number}", "say which with --to PUSH; nothing was written")
    return _base(last, f"the table that was in force before push {number}")
