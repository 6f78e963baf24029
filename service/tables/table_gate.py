"""The gate before any motion or use of a table: a table in force that corrects anything needs an endorsement for this control.

A control is known by its address alone (`control_of`), which may change. Each table contains a random number, so its CRC identifies it: the
CRC is looked up in all journals of the database, under any machine name. A pushed table that was neither kept nor accepted is refused. An
endorsement holds for one control only, because another machine has other errors.
"""

from __future__ import annotations

import asyncio
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from abbe.drivers.api import BankState, CompStatus, TableController
from abbe.service.clock import SystemClock
from abbe.service.domain.document import Doc, parsed
from abbe.service.domain.push_entry import BEFORE_ACTIVATION, TERMINAL, PushEntry, PushState
from abbe.service.errors import TableMismatch
from abbe.service.push.journal import StoreBook
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import read_base

How = Literal["verified", "accepted", "found in force"]
Row = tuple[Hashable, str, Doc]
"""Push, state, and the document of the entry."""


@dataclass(frozen=True, slots=True)
class PushedTable:
    """A push: name of its journal (``chain``), machine name, control (empty: not recorded), and last state."""

    chain: str
    push: int
    state: str
    machine: str
    control: str

    @property
    def open(self) -> bool:
        """Whether the push has not ended or waits for a person."""
        return self.state not in TERMINAL or self.state == PushState.OPERATOR

    @property
    def may_be_active(self) -> bool:
        """Whether the table of the push may be in force."""
        return self.open and self.state not in BEFORE_ACTIVATION


@dataclass(frozen=True, slots=True)
class Endorsement:
    """Why a table is valid on one control: a push kept it, a person accepted it, or the first push found it in force.

    ``push``: 0 for an acceptance before the first push; ``by``: who accepted it, empty for no person.
    """

    how: How
    machine: str
    push: int
    utc: str
    by: str = ""

    @property
    def not_here(self) -> str:
        """Text of a refusal on another machine, where the endorsement does not hold."""
        push = f" (push {self.push})" if self.push and self.how == "verified" else ""
        return f"{self.how} on machine {self.machine!r}{push}, not on this one"


@dataclass(frozen=True, slots=True)
class KnownTables:
    """Tables by their CRC, over all journals of a database.

    ``unverified``: tables that were neither kept nor accepted, with the push that wrote each; ``known_crcs``: every table that a push wrote
    or found in force, or that a person accepted; ``pushed``: the last push of each table; ``endorsed``: its endorsements by journal.
    """

    unverified: dict[int, PushedTable]
    known_crcs: frozenset[int]
    pushed: dict[int, PushedTable]
    endorsed: dict[int, dict[str, Endorsement]]

    def elsewhere(self, crc: int, chain: str) -> Endorsement | None:
        """Best endorsement of a table in other journals; None if the journal ``chain`` endorses it, or no journal does."""
        journals = self.endorsed.get(crc, {})
        return None if chain in journals else max(journals.values(), key=lambda one: (one.how == "verified", one.utc), default=None)


def known_tables(store: Store) -> KnownTables:
    """Read the journals of all machines, without the images in them."""
    marks = store.pushes.marks()
    unverified = _unverified([((m.machine, m.push), m.state, m.doc) for m in marks])
    last: dict[Hashable, PushedTable] = {}
    crc: dict[Hashable, int] = {}
    endorsed: dict[int, dict[str, Endorsement]] = {}
    crcs: set[int] = set()
    for mark in marks:
        key, doc = (mark.machine, mark.push), mark.doc
        named = (last[key].machine, last[key].control) if key in last else (doc.get("machine", mark.machine), doc.get("control", ""))
        last[key] = PushedTable(mark.machine, mark.push, mark.state, str(named[0]), str(named[1]))
        known = parsed(_Crcs, doc)
        crcs.update(one for one in (known.base_crc, known.crc, known.accepted_crc) if one is not None)
        if mark.state == PushState.SNAPSHOT and known.begun is not None:
            base, written = known.begun
            if base in endorsed or base not in crc.values():
                _add(endorsed, base, "found in force", last[key], mark)
            crc[key] = written
        elif mark.state == PushState.KEEP and key in crc:
            _add(endorsed, crc[key], "verified", last[key], mark)
        elif known.accepted_crc is not None:
            _add(endorsed, known.accepted_crc, "accepted", last[key], mark)
    pushed = {number: last[key] for key, number in crc.items()}
    return KnownTables({number: last[key] for number, key in unverified.items()}, frozenset(crcs), pushed, endorsed)


def _add(endorsed: dict[int, dict[str, Endorsement]], crc: int, how: How, push: PushedTable, mark: PushEntry) -> None:
    """Add an endorsement to a journal; "found in force" never replaces an earlier one."""
    one = Endorsement(how, push.machine, push.push, mark.utc, str(mark.doc.get("by", "")) if how == "accepted" else "")
    journals, chain = endorsed.setdefault(crc, {}), push.chain
    if how != "found in force" or chain not in journals:
        journals[chain] = one


def unverified_crcs(entries: Sequence[PushEntry]) -> dict[int, int]:
    """Tables of one journal that were neither kept nor accepted: CRC -> number of the push."""
    found = _unverified([(e.push, e.state, e.doc) for e in entries])
    return {crc: push for crc, push in found.items() if isinstance(push, int)}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Crcs:
    """The tables that an entry of the push journal names: found in force, written, accepted by a person."""

    base_crc: int | None = None
    crc: int | None = None
    accepted_crc: int | None = None

    @property
    def begun(self) -> tuple[int, int] | None:
        """The table found in force and the one to be written, of the first entry of a push; None if it names none."""
        if self.crc is None:
            return None
        if self.base_crc is None:
            raise KeyError("base_crc")
        return self.base_crc, self.crc


def _unverified(rows: Iterable[Row]) -> dict[int, Hashable]:
    """Unverified tables. A table found in force counts as endorsed, unless an earlier push wrote it and did not keep it."""
    candidates: dict[int, Hashable] = {}
    pushed: dict[Hashable, int] = {}
    endorsed: set[int] = set()
    for push, state, doc in rows:
        known = parsed(_Crcs, doc)
        if state == PushState.SNAPSHOT and known.begun is not None:
            base, crc = known.begun
            if base not in candidates:
                endorsed.add(base)
            pushed[push] = crc
            candidates.setdefault(crc, push)
        elif state == PushState.KEEP and push in pushed:
            endorsed.add(pushed[push])
        elif state == PushState.ACCEPTED and known.accepted_crc is not None:
            endorsed.add(known.accepted_crc)
    return {crc: push for crc, push in candidates.items() if crc not in endorsed}


LOOK_REMEDY = "look at the controller; if its table is right, say so with `abbe accept-table -m MACHINE.toml`"
STRANGE = "a table that this database did not push"
ACCEPT_REMEDY = (
    "find out who wrote this table; if it is right, accept it with `abbe accept-table -m MACHINE.toml --yes`, or repeat the command with "
    "--accept-table; nothing has moved"
)


@dataclass(frozen=True, slots=True)
class InForceNow:
    """The table in force, judged by all journals of the database.

    ``unverified``: the push that wrote it, if nothing has verified it; ``strange``: it corrects something and is in no journal;
    ``elsewhere``: it corrects something and is endorsed for other controls only.
    """

    status: CompStatus
    unverified: PushedTable | None
    strange: bool
    elsewhere: Endorsement | None

    @property
    def crc(self) -> int:
        """CRC-32 of the active bank."""
        return self.status.bank_crc[self.status.active_bank]


async def identify_table(
    controller: TableController, known: KnownTables, chain: str, corrects: dict[int, bool] | None = None
) -> InForceNow:
    """Identify the active table by the journals. Its content is read only if ``chain``, the journal of this control, does not endorse it.

    ``corrects`` caches by CRC whether a table corrects anything.

    Raises
    ------
    TableMismatch
        The content of an unknown table does not match the CRC that the controller states.
    """
    now = await controller.comp_status()
    crc = now.bank_crc[now.active_bank]
    unverified, elsewhere = known.unverified.get(crc), known.elsewhere(crc, chain)
    asked = (crc not in known.known_crcs or elsewhere is not None) and unverified is None
    read = {} if corrects is None else corrects
    if asked and crc not in read:
        read[crc] = await _corrects(controller, now)
    acts = asked and read[crc]
    return InForceNow(now, unverified, acts and crc not in known.known_crcs, elsewhere if acts else None)


async def _corrects(controller: TableController, now: CompStatus) -> bool:
    """Whether the active bank holds any correction. An unreadable table counts as one."""
    if now.bank_state[now.active_bank] is not BankState.SEALED:
        return False
    base = await read_base(controller)
    try:
        tables = base.tables
    except TableMismatch:
        return True
    return tables is not None and any(bool(np.any(curve)) for curve in tables.correction_mm)


async def check_in_force(controller: TableController, store: Store, site: Site) -> None:
    """Refuse a table in force that a push left unverified, or that corrects something without an endorsement for this control.

    Raises
    ------
    TableMismatch
        The message names the origin of the table and the remedy.
    """
    now = await identify_table(controller, *await asyncio.to_thread(_journals, store, site))
    if now.unverified is not None:
        whose = await asyncio.to_thread(_whose, store, site, now.unverified)
        raise TableMismatch(
            f"the table in force (CRC {now.crc:08X}) is that of {whose}, which was never verified", _remedy(site, now.unverified)
        )
    if now.strange:
        raise TableMismatch(f"{STRANGE} (CRC {now.crc:08X}) is in force", ACCEPT_REMEDY)
    if now.elsewhere is not None:
        raise TableMismatch(f"the table in force (CRC {now.crc:08X}) was {now.elsewhere.not_here}", ACCEPT_REMEDY)


def _journals(store: Store, site: Site) -> tuple[KnownTables, str]:
    return known_tables(store), store.pushes.chain(site.name, site.control)


def _whose(store: Store, site: Site, push: PushedTable) -> str:
    if push.chain == store.pushes.chain(site.name, site.control) and push.machine == site.name:
        return f"push {push.push}"
    at = f" at {push.control}" if push.control and push.control != site.control else ""
    return f"push {push.push} of machine {push.machine!r}{at}"


def _remedy(site: Site, push: PushedTable) -> str:
    if push.may_be_active and push.state != PushState.OPERATOR and push.machine != site.name:
        return f"start any command with the machine file of {push.machine!r}, which rolls it back; or {LOOK_REMEDY}"
    return LOOK_REMEDY


async def accept_strange(controller: TableController, store: Store, site: Site, by: str) -> str | None:
    """Accept the table in force if this database did not push it into this control; return a sentence about it, else None.

    An unverified table that this database pushed is not accepted here: `abbe accept-table` can do that.
    """
    now = await identify_table(controller, *await asyncio.to_thread(_journals, store, site))
    if not now.strange and now.elsewhere is None:
        return None
    await vouch(store, site, now.status, by)
    what = STRANGE if now.elsewhere is None else f"a table that was {now.elsewhere.not_here}"
    return f"{what} (CRC {now.crc:08X}) is accepted by {by}"


async def vouch(store: Store, site: Site, now: CompStatus, by: str) -> None:
    """Record in the journal of the control that a person accepts the table in force. The last push must have ended."""
    book = await StoreBook.for_acceptance(store, site.name, SystemClock(), site.control)
    journal = await book.entries()
    await book.append(
        journal, PushState.ACCEPTED, acceptance_doc(now, by) | ({} if journal else {"machine": site.name, "control": site.control})
    )


def acceptance_doc(now: CompStatus, by: str) -> Doc:
    """Document of a journal entry by which a person accepts a table."""
    return {"accepted_bank": now.active_bank, "accepted_crc": now.bank_crc[now.active_bank], "by": by}
