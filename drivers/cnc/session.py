"""Shared by all requests to the controller: identity, coherent status, and detection of a restart."""

from __future__ import annotations

import time

from abbe.drivers.api import ControllerStatus, DeviceInfo, TableFormat
from abbe.drivers.cnc import registers as reg
from abbe.drivers.errors import Rebooted, WrongDevice
from abbe.drivers.links.modbus_link import ModbusLink
from abbe.drivers.links.words import check_clock, check_identity


class ControllerSession:
    """A link that verifies that its peer is the same run of the same controller."""

    def __init__(self, link: ModbusLink) -> None:
        self.link = link
        self.name = link.name
        self.fifo_size = 0
        self._boot_id: int | None = None
        self._map = ""
        self._connection = link.connections
        self._last_us = -1

    async def identify(self) -> DeviceInfo:
        """Read the identity of the controller, and accept its boot id as the current one.

        Raises
        ------
        WrongDevice
            Canary registers or register map are not those of docs/protocols/cnc.md.
        LinkDown, ReplyTimeout, BadFrame
            The wire.
        """
        self._map = ""
        counts = await self._identity()
        status = reg.decode_status(await self.link.read_block(reg.STATUS), time.monotonic()).status
        try:
            check_clock(self.name, status.ctrl_us)
        except WrongDevice as error:
            self.link.incidents.note(error, latched=True)
            raise
        self._boot_id = counts["BOOT_ID"]
        self._connection = self.link.connections
        self._last_us = -1
        self.link.incidents.accepted()
        return DeviceInfo("cnc", f"{counts['N_AXES']}-axis controller", "", counts["BOOT_ID"], self._map)

    async def check_boot(self) -> None:
        """Raise ``Rebooted`` if the controller restarted since ``identify``."""
        counts = await self._identity()
        if self._boot_id is None:
            self._boot_id = counts["BOOT_ID"]
        if counts["BOOT_ID"] != self._boot_id:
            detail = f"boot id {counts['BOOT_ID']:#x} instead of {self._boot_id:#x}"
            remedy = "the controller restarted: call identify, check its tables, measure again"
            error = Rebooted(self.name, "check boot id", detail, remedy)
            self.link.incidents.note(error, latched=True)
            raise error
        # Only now: until this succeeds, every status checks again, and an unverified device gets no command.
        self._connection = self.link.connections

    async def status(self) -> ControllerStatus:
        """Read the controller's status; see `block`."""
        return (await self.block()).status

    async def block(self) -> reg.StatusBlock:
        """Read the status block in one request.

        Raises
        ------
        Rebooted
            The controller restarted since ``identify``.
        LinkDown, ReplyTimeout, BadFrame
            The wire.
        """
        words = await self.link.read_block(reg.STATUS)
        block = reg.decode_status(words, time.monotonic())
        # This block has no boot id: check it after a new connection, or when the clock went back.
        if self._boot_id is None or block.status.ctrl_us < self._last_us or self._connection != self.link.connections:
            await self.check_boot()
        self._last_us = block.status.ctrl_us
        return block

    async def table_format(self) -> TableFormat:
        """Read the unit and the size of the controller's table banks."""
        counts = await self._identity()
        return TableFormat(counts["TABLE_LSB_NM"], counts["BANK_SIZE"])

    async def _identity(self) -> dict[str, int]:
        counts = reg.IDENTITY.counts(await self.link.read_block(reg.IDENTITY))
        try:
            check_identity(self.name, counts, reg.MAP_VERSION)
            self._check_map(counts)
        except WrongDevice as error:
            self.link.incidents.note(error, latched=True)
            raise
        self.fifo_size = counts["FIFO_SIZE"]
        return counts

    def _check_map(self, counts: dict[str, int]) -> None:
        """Refuse a register map that this driver does not support, or that changed since ``identify``."""
        found = reg.fingerprint(counts)
        for name, expected in (("N_AXES", reg.AXES), ("BANK_SIZE", reg.BANK_REGISTERS)):
            if counts[name] != expected:
                detail = f"{name} is {counts[name]} instead of {expected} ({found})"
                raise WrongDevice(self.name, "identify", detail, "install the matching firmware, or the matching version of this program")
        if self._map and found != self._map:
            detail = f"its register map changed: {found}, it was {self._map}"
            raise WrongDevice(self.name, "identify", detail, "another firmware: identify it anew, check its tables")
        self._map = found
