"""The gate before any motion or use of a table: a table in force that corrects anything needs an endorsement for this control.

A control is known by its address alone (`control_of`), which may change. A pushed table that was neither kept nor accepted is refused. An
endorsement holds for one control only, because another machine has other errors.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

import numpy as np

from abbe.drivers.api import BankState, CompStatus, TableController
from abbe.service.clock import SystemClock
from abbe.service.domain.document import Doc
from abbe.service.domain.push_entry import PushState
from abbe.service.errors import TableMismatch
from abbe.service.push.journal import StoreBook
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.known_tables import Endorsement, KnownTables, PushedTable, known_tables
from abbe.service.tables.nine_tables import read_base

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
    return known_tables(store), store.pushes.chain(site.name, site.urls.control)


def _whose(store: Store, site: Site, push: PushedTable) -> str:
    if push.chain == store.pushes.chain(site.name, site.urls.control) and push.machine == site.name:
        return f"push {push.push}"
    at = f" at {push.control}" if push.control and push.control != site.urls.control else ""
    return f"push {push.push} of machine {push.machine!r}{at}"


def _remedy(site: Site, push: PushedTable) -> str:
    if push.may_be_active and push.state != PushState.OPERATOR and push.machine != site.name:
        return f"start any command with the machine file of {push.machine!r}, which rolls it back; or {LOOK_REMEDY}"
    return LOOK_REMEDY


async def accept_strange(controller: TableController, store: Store, site: Site, by: str) -> str | None:
    """Accept the table in force if this database did not push it into this control; return a sentence about that, None if it was pushed.

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
    book = await StoreBook.for_acceptance(store, site.name, SystemClock(), site.urls.control)
    journal = await book.entries()
    await book.append(
        journal, PushState.ACCEPTED, acceptance_doc(now, by) | ({} if journal else {"machine": site.name, "control": site.urls.control})
    )


def acceptance_doc(now: CompStatus, by: str) -> Doc:
    """Document of a journal entry by which a person accepts a table."""
    return {"accepted_bank": now.active_bank, "accepted_crc": now.bank_crc[now.active_bank], "by": by}
