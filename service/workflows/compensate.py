"""A table's way into the controller: stage to the inactive bank, read back twice, seal, activate by compare-and-swap, confirm.

The active bank is never written, and activation names the CRC and generation that were read back. From the moment in which activation may
have happened, whatever goes wrong takes the old table back; what cannot be taken back at once is journaled and tried again before anything
else. Every state is a row of the push journal before the action it permits.
"""

from __future__ import annotations

import secrets
from dataclasses import asdict, dataclass
from typing import Any

from drivers.api import CompStatus, Controller
from drivers.cnc.tables import crc32, encode
from drivers.links.shielded import run_to_end
from models.compensation.tables import NineTables
from service.errors import StillActive, TableMismatch, TableRefused
from service.site import Site
from service.storage.owner import this_process
from service.storage.store import Store
from service.workflows.tables import check_limits, compare_bytes, compare_meaning, table_image, tables_from_image
from service.workflows.takeback import LEASE_MS, Ending, release_quietly, take_back

STILL_ACTIVE = "the unverified table is STILL ACTIVE"
MAKE_READY = "make the machine ready (interlocks, link); the next abbe command takes it back before anything else"


@dataclass(frozen=True, slots=True)
class Pushed:
    """A table that is active and confirmed, and what stands in the other bank for the way back."""

    push_id: int
    table_id: int
    bank: int
    crc: int
    previous_bank: int
    previous_crc: int
    log: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Base:
    """The table in force before a push."""

    status: CompStatus
    image: bytes

    @property
    def crc(self) -> int:
        """CRC-32 of the active bank as the controller sealed it."""
        return self.status.bank_crc[self.status.active_bank]

    @property
    def tables(self) -> NineTables | None:
        """The corrections in force; None for no correction."""
        return tables_from_image(self.image)


async def read_base(controller: Controller) -> Base:
    """Read the active bank and prove it against its CRC.

    Raises
    ------
    TableMismatch
        The bytes do not have the CRC the controller states.
    """
    status = await controller.comp_status()
    base = Base(status, await controller.read_bank(status.active_bank))
    if crc32(base.image) != base.crc:
        raise TableMismatch("the active table does not have the CRC the controller states", "read the tables again; nothing was written")
    return base


class Pusher:
    """One push, step by step, with its journal in the store."""

    def __init__(self, controller: Controller, store: Store, site: Site) -> None:
        self._c = controller
        self._store = store
        self._site = site
        self._owner = secrets.randbits(31) | 1
        self._log: list[str] = []
        self._push_id = 0
        self._journal: dict[str, Any] = {}
        self._started = False

    async def push(self, tables: NineTables, *, base: Base, solution_id: int | None, doc: dict[str, Any]) -> Pushed:
        """Bring tables to the controller and make them active.

        Parameters
        ----------
        tables : NineTables
            Absolute corrections, in the controller's unit (`models.compensation.tables.quantise`).
        base : Base
            The table in force, as `read_base` gave it: nothing is activated if another one is in force by then.

        Raises
        ------
        TableRefused
            A limit is broken; nothing was written.
        TableMismatch
            What the controller holds is not what was sent; it is not active.
        StillActive
            Something went wrong after activation and the old table could not be made active again.
        """
        form = await self._c.table_format()
        check_limits(tables, base.tables, self._site.limits)
        image = encode(table_image(tables, form.lsb_nm, secrets.randbits(31)))
        if len(image) > 2 * form.bank_registers:
            raise TableRefused(f"the tables need {len(image) // 2} registers, a bank has {form.bank_registers}", "use a coarser grid")
        target = 1 - base.status.active_bank
        table_id = await self._open_journal(base, target, image, solution_id, doc)
        try:
            await self._c.lease(self._owner, LEASE_MS)
            try:
                await self._stage(target, image, tables, form.lsb_nm)
                await self._activate(base, target, crc32(image))
            finally:
                await release_quietly(self._c, self._owner)
        except BaseException as error:
            await self.back_out(error)
            raise
        return Pushed(self._push_id, table_id, target, crc32(image), base.status.active_bank, base.crc, tuple(self._log))

    async def _open_journal(self, base: Base, target: int, image: bytes, solution_id: int | None, doc: dict[str, Any]) -> int:
        machine_id = await self._store.write(self._store.add_machine, self._site.name, self._site.doc)
        table_id = await self._store.write(self._store.add_table, machine_id, solution_id, image, crc32(image), doc)
        self._journal = {"base_bank": base.status.active_bank, "base_crc": base.crc, "base_image_hex": base.image.hex()}
        self._journal |= {"target_bank": target, "crc": crc32(image), "boot_id": base.status.boot_id, "owner": asdict(this_process())}
        self._push_id = await self._store.write(self._store.add_push, machine_id, table_id, "STAGING", self._journal)
        self._note(f"base: bank {base.status.active_bank}, CRC {base.crc:08X}; target: bank {target}")
        return table_id

    async def _stage(self, target: int, image: bytes, tables: NineTables, lsb_nm: int) -> None:
        """Write, read back, compare bytes; read again and compare meaning through the independent decoder; seal; compare the CRC."""
        await self._c.write_bank(target, image)
        compare_bytes(image, await self._c.read_bank(target, len(image)))
        compare_meaning(tables, tables_from_image(await self._c.read_bank(target, len(image))), lsb_nm)
        await self._c.seal(target, self._owner)
        sealed = (await self._c.comp_status()).bank_crc[target]
        if sealed != crc32(image):
            raise TableMismatch(f"bank {target} was sealed with CRC {sealed:08X}, sent {crc32(image):08X}", "it is not active; push again")
        self._note(f"bank {target} read back twice, sealed with CRC {sealed:08X}")

    async def _activate(self, base: Base, target: int, crc: int) -> None:
        now = await self._c.comp_status()
        active = now.active_bank
        if (now.boot_id, active, now.bank_crc[active]) != (base.status.boot_id, base.status.active_bank, base.crc):
            raise TableMismatch("the active table changed, or the controller restarted, during the push", "look at it, then push again")
        await self._state("ACTIVATING", {"expect_crc": crc, "expect_gen": now.gen})
        self._started = True
        await self._c.activate(target, expect_crc=crc, expect_gen=now.gen, owner=self._owner)
        await self._confirm(target, crc)
        await self._state("PROBATION", {})
        self._note(f"bank {target} active and read back again: CRC {crc:08X}")

    async def _confirm(self, target: int, crc: int) -> None:
        now = await self._c.comp_status()
        if (now.active_bank, now.bank_crc[target]) != (target, crc) or crc32(await self._c.read_bank(target)) != crc:
            raise TableMismatch(
                "the controller's active table is not the one that was sent", "look at the controller before moving the machine"
            )

    async def keep(self) -> None:
        """The new table was verified: check that it is still the one in force, and close the journal.

        Raises
        ------
        TableMismatch
            Somebody changed the active table during the verification.
        """
        await self._confirm(int(self._journal["target_bank"]), int(self._journal["crc"]))
        await self._state("VERIFIED", {})

    async def go_back(self, why: str) -> None:
        """The new table is not better: make the old one active again, also when the caller is cancelled meanwhile.

        Raises
        ------
        StillActive, TableMismatch
            It could not be done (now), or a person must look.
        """
        ending = await run_to_end(take_back(self._c, self._store, self._push_id, self._journal, why))
        self._complain(ending, why, None)

    async def back_out(self, error: BaseException) -> None:
        """Something stopped the push or its verification: nothing unverified stays active. The caller raises ``error`` again.

        Raises
        ------
        StillActive, TableMismatch
            Instead of ``error`` (and naming it), when the old table could not be made active again. A cancellation is never replaced.
        """
        why = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        if not self._started:  # activation was never asked for: the old table is in force
            await run_to_end(self._state("ABORTED", {"why": why}))
            return
        ending = await run_to_end(take_back(self._c, self._store, self._push_id, self._journal, why))
        if isinstance(error, Exception):
            self._complain(ending, str(error), error)

    def _complain(self, ending: Ending, why: str, cause: Exception | None) -> None:
        if ending == "ROLLBACK_PENDING":
            raise StillActive(f"{why}; {STILL_ACTIVE}", MAKE_READY) from cause
        if ending == "OPERATOR":
            raise TableMismatch(f"{why}; the controller holds a table that the journal does not know", "look at the controller") from cause

    async def _state(self, state: str, doc: dict[str, Any]) -> None:
        self._journal |= doc
        await self._store.write(self._store.update_push, self._push_id, state, self._journal)

    def _note(self, text: str) -> None:
        self._log.append(text)
