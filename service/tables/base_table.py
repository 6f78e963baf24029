"""The table that is in force in a controller, read and proved against the CRC that the controller states."""

from __future__ import annotations

from dataclasses import dataclass

from abbe.drivers.api import CompStatus, TableController
from abbe.drivers.tables import crc32
from abbe.models.compensation.tables import NineTables
from abbe.service.errors import TableMismatch
from abbe.service.tables.nine_tables import tables_from_image


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
    """Read the active bank and prove it against its CRC.

    Raises
    ------
    TableMismatch
        The CRC of the bytes differs from the one the controller states.
    """
    status = await controller.comp_status()
    base = Base(status, await controller.read_bank(status.active_bank))
    if crc32(base.image) != base.crc:
        raise TableMismatch("the active table does not have the CRC the controller states", "read the tables again; nothing was written")
    return base
