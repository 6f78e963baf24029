"""Solution to table to controller: check limits, stage to the inactive bank, read back twice, seal, activate by compare-and-swap, confirm.

At no instant is a table active that was not verified: the active bank is never written, and activation names the CRC and generation that
were read back. Every state is a row of the push journal before the action it permits.
"""

from __future__ import annotations

import secrets
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from drivers.api import CompStatus, Controller
from drivers.cnc.second_decoder import UnreadableImage, read_axis_tables
from drivers.cnc.tables import TableImage, crc32, encode
from models.compensation.tables import NineTables
from models.machine import AXES
from service.errors import TableMismatch, TableRefused
from service.site import Site, TableLimits
from service.storage.owner import this_process
from service.storage.store import Store

KIND_NINE = 1
LEASE_MS = 60_000


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


def table_image(tables: NineTables, lsb_nm: int, table_id: int) -> TableImage:
    """Nine tables as the controller stores them: for each input axis X, Y, Z, for each output X, Y, Z, corrections in LSB (cnc.md).

    Raises
    ------
    TableRefused
        A grid is not equidistant, or a value does not fit the controller's 16 bits.
    """
    start, step, counts, values = [], [], [], []
    for a in range(3):
        grid = tables.position_mm[a]
        pitch = np.diff(grid)
        if np.ptp(pitch) > 1e-6:
            raise TableRefused(
                f"table of {AXES[a]}: the grid is not equidistant", "resample it on the controller's grid; nothing was written"
            )
        start.append(float(grid[0]))
        step.append(float(pitch[0]))
        counts.append(int(grid.size))
        for i in range(3):
            values += [int(v) for v in np.round(tables.correction_mm[a][:, i] * 1e6 / lsb_nm)]
    if max(map(abs, values)) > 32767:
        raise TableRefused("a correction does not fit the controller's 16-bit entries", "check the solution; nothing was written")
    sx, sy, sz = start
    px, py, pz = step
    nx, ny, nz = counts
    return TableImage(KIND_NINE, table_id, lsb_nm, (sx, sy, sz), (px, py, pz), (nx, ny, nz), tuple(values))


def check_limits(tables: NineTables, active: NineTables | None, limits: TableLimits) -> None:
    """Refuse, never clamp: value, change against the active table, step between neighbours, zero at the reference (reliability.md 3.3).

    Raises
    ------
    TableRefused
        Which table, where, how much over which limit. Nothing has been written.
    """
    for a in range(3):
        for i in range(3):
            values = tables.correction_mm[a][:, i]
            before = np.zeros_like(values)
            if active is not None:
                before = np.interp(tables.position_mm[a], active.position_mm[a], active.correction_mm[a][:, i])
            name = f"table of {AXES[i]} over {AXES[a]}"
            if not np.isfinite(values).all():
                raise TableRefused(f"{name}: holds values that are no numbers", "check the solution; nothing was written")
            checks = (
                ("value", np.abs(values), limits.value_mm, "table_value_um"),
                ("change against the active table", np.abs(values - before), limits.change_mm, "table_change_um"),
                ("step between neighbours", np.abs(np.diff(values)), limits.step_mm, "table_step_um"),
            )
            for what, size, limit, key in checks:
                k = int(np.argmax(size))
                if size[k] > limit:
                    at = tables.position_mm[a][k]
                    raise TableRefused(
                        f"{name}: {what} {size[k] * 1e3:.1f} µm at {at:.1f} mm exceeds the limit of {limit * 1e3:.1f} µm",
                        f"check the measurement; if the machine is really so, raise {key} under [limits]. Nothing was written",
                    )
            if abs(values[0]) > 5e-7:
                raise TableRefused(f"{name}: not zero at its reference", "shift the table; nothing was written")


def tables_from_image(image: bytes) -> NineTables | None:
    """Tables in a bank image by the independent decoder; None for an image without correction (kind 0).

    Raises
    ------
    TableMismatch
        The bank holds a kind of table that this version cannot read.
    """
    try:
        curves = read_axis_tables(image)
    except UnreadableImage as error:
        raise TableMismatch(
            f"a bank holds no table that can be read: {error}", "look at the controller's banks; nothing was activated"
        ) from None
    if not curves:
        return None
    positions, corrections = [], []
    for a in AXES:
        positions.append(np.array([p for p, _ in curves[(a, "X")]]))
        corrections.append(np.column_stack([[c for _, c in curves[(a, i)]] for i in AXES]))
    none = tuple(np.full_like(c, np.nan) for c in corrections)
    return NineTables(
        (positions[0], positions[1], positions[2]), (corrections[0], corrections[1], corrections[2]), (none[0], none[1], none[2])
    )


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

    async def push(self, tables: NineTables, *, lsb_nm: int, solution_id: int | None, doc: dict[str, Any]) -> Pushed:
        """Bring tables to the controller and make them active.

        Raises
        ------
        TableRefused
            A limit is broken; nothing was written.
        TableMismatch
            What the controller holds is not what was sent; it was not activated.
        """
        base = await self._c.comp_status()
        base_image = await self._c.read_bank(base.active_bank)
        if crc32(base_image) != base.bank_crc[base.active_bank]:
            raise TableMismatch(
                "the active table does not have the CRC the controller states", "read the tables again; nothing was written"
            )
        check_limits(tables, tables_from_image(base_image), self._site.limits)
        image = encode(table_image(tables, lsb_nm, secrets.randbits(31)))
        target = 1 - base.active_bank
        machine_id = await self._store.write(self._store.add_machine, self._site.name, self._site.doc)
        table_id = await self._store.write(self._store.add_table, machine_id, solution_id, image, crc32(image), doc)
        self._journal = {"base_bank": base.active_bank, "base_crc": base.bank_crc[base.active_bank], "base_image_hex": base_image.hex()}
        self._journal |= {
            "target_bank": target,
            "crc": crc32(image),
            "boot_id": base.boot_id,
            "gen": base.gen,
            "owner": asdict(this_process()),
        }
        self._push_id = await self._store.write(self._store.add_push, machine_id, table_id, "STAGING", self._journal)
        self._note(f"base: bank {base.active_bank}, CRC {base.bank_crc[base.active_bank]:08X}; target: bank {target}")
        await self._c.lease(self._owner, LEASE_MS)
        try:
            await self._stage(target, image, tables, lsb_nm)
            await self._activate(base, target, crc32(image))
        finally:
            await self._c.release(self._owner)
        return Pushed(self._push_id, table_id, target, crc32(image), base.active_bank, base.bank_crc[base.active_bank], tuple(self._log))

    async def _stage(self, target: int, image: bytes, tables: NineTables, lsb_nm: int) -> None:
        """Write, read back, compare bytes; read again and compare meaning through the independent decoder; seal; compare the CRC."""
        await self._c.write_bank(target, image)
        first = await self._c.read_bank(target, len(image))
        compare_bytes(image, first)
        second = await self._c.read_bank(target, len(image))
        compare_meaning(tables, tables_from_image(second), lsb_nm)
        await self._c.seal(target, self._owner)
        sealed = (await self._c.comp_status()).bank_crc[target]
        if sealed != crc32(image):
            await self._state("ABORTED", {"why": "sealed CRC differs"})
            raise TableMismatch(
                f"bank {target} was sealed with CRC {sealed:08X}, sent {crc32(image):08X}", "it was not activated; push again"
            )
        self._note(f"bank {target} read back twice, sealed with CRC {sealed:08X}")

    async def _activate(self, base: CompStatus, target: int, crc: int) -> None:
        now = await self._c.comp_status()
        if (now.boot_id, now.active_bank, now.bank_crc[base.active_bank]) != (
            base.boot_id,
            base.active_bank,
            base.bank_crc[base.active_bank],
        ):
            await self._state("ABORTED", {"why": "the active table changed during the push"})
            raise TableMismatch(
                "somebody changed the active table, or the controller restarted, during the push", "look at it, then push again"
            )
        await self._state("ACTIVATING", {"expect_crc": crc, "expect_gen": now.gen})
        await self._c.activate(target, expect_crc=crc, expect_gen=now.gen, owner=self._owner)
        active = await self._c.comp_status()
        image = await self._c.read_bank(target)
        if active.active_bank != target or active.bank_crc[target] != crc or crc32(image) != crc:
            await self._state("OPERATOR", {"why": "active table is not the one sent"})
            raise TableMismatch(
                "the controller's active table is not the one that was sent", "look at the controller before moving the machine"
            )
        await self._state("PROBATION", {})
        self._note(f"bank {target} active and read back again: CRC {crc:08X}")

    async def roll_back(self, pushed: Pushed, why: str) -> None:
        """Make the previous bank active again, by compare-and-swap on its own CRC.

        Raises
        ------
        TableMismatch
            The previous bank is no longer what it was; nothing was switched.
        """
        now = await self._c.comp_status()
        if now.bank_crc[pushed.previous_bank] != pushed.previous_crc:
            await self._state("OPERATOR", {"why": "the previous table is gone"})
            raise TableMismatch("the previous table is no longer in its bank", "restore it from the push journal by hand")
        await self._c.lease(self._owner, LEASE_MS)
        try:
            await self._c.activate(pushed.previous_bank, expect_crc=pushed.previous_crc, expect_gen=now.gen, owner=self._owner)
        finally:
            await self._c.release(self._owner)
        await self._state("ROLLED_BACK", {"why": why})

    async def keep(self) -> None:
        """The new table was verified: close the journal."""
        await self._state("VERIFIED", {})

    async def _state(self, state: str, doc: dict[str, Any]) -> None:
        self._journal |= doc
        await self._store.write(self._store.update_push, self._push_id, state, self._journal)

    def _note(self, text: str) -> None:
        self._log.append(text)


def compare_bytes(sent: bytes, held: bytes) -> None:
    """First read-back: every byte.

    Raises
    ------
    TableMismatch
        The first register that differs.
    """
    if sent != held:
        at = next((k for k in range(min(len(sent), len(held))) if sent[k] != held[k]), min(len(sent), len(held)))
        raise TableMismatch(
            f"read-back differs from what was sent at register {at // 2}", "the table was not activated; check the link, push again"
        )


def compare_meaning(wanted: NineTables, held: NineTables | None, lsb_nm: int) -> None:
    """Second read-back: what an independent decoder makes of the bytes must be the wanted correction, axis by axis, within half a unit.

    Raises
    ------
    TableMismatch
        Which table differs: this catches a wrong sign, a swapped axis, or a wrong unit in the encoder.
    """
    for a in range(3):
        for i in range(3):
            name = f"{AXES[i]} over {AXES[a]}"
            if held is None or held.correction_mm[a].shape != wanted.correction_mm[a].shape:
                raise TableMismatch(f"table {name} is not in the controller's bank", "it was not activated")
            off_grid = np.abs(held.position_mm[a] - wanted.position_mm[a]).max()
            off_value = np.abs(held.correction_mm[a][:, i] - wanted.correction_mm[a][:, i]).max()
            if off_grid > 1e-5 or off_value > 0.51e-6 * lsb_nm:
                raise TableMismatch(
                    f"table {name} means something else to an independent decoder (off by {off_value * 1e3:.2f} µm)",
                    "it was not activated; the encoder is wrong",
                )
