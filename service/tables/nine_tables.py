"""The nine one-axis tables of a controller: encode, decode, check limits, add a change to them, and read those in force."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from abbe.drivers.api import CompStatus, TableController
from abbe.drivers.second_decoder import UnreadableImage, read_axis_tables
from abbe.drivers.tables import TableImage, crc32
from abbe.models.compensation.tables import NineTables
from abbe.models.machine import AXES
from abbe.service.errors import TableMismatch, TableRefused
from abbe.service.push.validate import PushLimits, size_reasons, together_reasons

KIND_NINE = 1


def table_image(tables: NineTables, lsb_nm: int, table_id: int) -> TableImage:
    """Encode nine tables for the controller: corrections in LSB, input axis outermost, then output (docs/protocols/cnc.md).

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


def check_test_step(tables: NineTables, active: NineTables | None, limits: PushLimits) -> None:
    """Refuse the tables of a test step that break a limit or are not zero at the reference; never clamp them.

    The limits apply to size, change against the active table and steps between neighbours, but not to curvature.

    Raises
    ------
    TableRefused
        The message names table, position, excess and limit. Nothing has been written.
    """
    against, limits = [], replace(limits, second_mm=np.inf)
    for a in range(3):
        position = tables.position_mm[a]
        for i in range(3):
            values = tables.correction_mm[a][:, i]
            before = np.zeros_like(values)
            if active is not None:
                before = np.interp(position, active.position_mm[a], active.correction_mm[a][:, i])
            name = f"table of {AXES[i]} over {AXES[a]}"
            if not np.isfinite(values).all():
                raise TableRefused(f"{name}: holds values that are not numbers", "check the solution; nothing was written")
            if abs(values[0]) > 5e-7:
                raise TableRefused(f"{name}: not zero at its reference", "shift the table to zero there; nothing was written")
            against += [f"{no} ({name})" for no in size_reasons(position.tolist(), values.tolist(), before.tolist(), limits)]
    for i in range(3):
        total_mm = sum(float(np.abs(tables.correction_mm[a][:, i]).max()) for a in range(3))
        against += together_reasons(AXES[i], total_mm, limits)
    if against:
        remedy = "if the machine really needs this, raise the limit in the machine file; nothing was written"
        raise TableRefused("; ".join(against), remedy)


def tables_from_image(image: bytes) -> NineTables | None:
    """Decode the tables of a bank image with the independent decoder; return None for an image without correction (kind 0).

    Raises
    ------
    TableMismatch
        The bank holds a kind of table that this version does not read.
    """
    try:
        curves = read_axis_tables(image)
    except UnreadableImage as error:
        raise TableMismatch(
            f"a bank of the controller holds no readable table: {error}", "look at the controller's banks; nothing was activated"
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


def added(active: NineTables | None, change: NineTables) -> NineTables:
    """Return ``active`` plus ``change`` on the grid of the change, zero at its first position.

    The change was measured with ``active`` in force, so the two corrections add up.
    """
    if active is None:
        return change
    curves = []
    for a in range(3):
        old = [np.interp(change.position_mm[a], active.position_mm[a], active.correction_mm[a][:, i]) for i in range(3)]
        curves.append(change.correction_mm[a] + np.column_stack(old) - np.array([v[0] for v in old]))
    return NineTables(change.position_mm, (curves[0], curves[1], curves[2]), change.u_mm)


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


async def read_base(controller: TableController) -> Base:
    """Read the active bank and check it against its CRC.

    Raises
    ------
    TableMismatch
        The CRC of the bytes differs from the one the controller states.
    """
    status = await controller.comp_status()
    base = Base(status, await controller.read_bank(status.active_bank))
    if crc32(base.image) != base.crc:
        raise TableMismatch(
            "the active table does not have the CRC that the controller states", "read the tables again; nothing was written"
        )
    return base
