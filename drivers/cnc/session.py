"""What every conversation with the controller needs: identity, coherent status, and noticing that it restarted."""

from __future__ import annotations

import time

from drivers.api import ControllerStatus, DeviceInfo, TableFormat
from drivers.cnc import registers as reg
from drivers.errors import Rebooted
from drivers.links.identity import check_identity
from drivers.links.modbus import ModbusLink


class ControllerSession:
    """A link whose other end is known to be one and the same run of one controller.

    Parameters
    ----------
    link : ModbusLink
        Open link to the controller.
    """

    def __init__(self, link: ModbusLink) -> None:
        self.link = link
        self.name = link.name
        self.fifo_size = 0
        self._boot_id: int | None = None
        self._connection = link.connections
        self._last_us = -1

    async def identify(self) -> DeviceInfo:
        """Ask the controller who it is, and accept its boot id as the one that counts from now on.

        Raises
        ------
        WrongDevice
            Canary registers or map version are not those of docs/protocols/cnc.md.
        LinkDown, ReplyTimeout, BadFrame
            The wire.
        """
        counts = await self._identity()
        self._boot_id = counts["BOOT_ID"]
        self._last_us = -1
        return DeviceInfo("cnc", f"{counts['N_AXES']}-axis controller", "", counts["BOOT_ID"], f"map {counts['MAP_VER']}")

    async def check_boot(self) -> None:
        """Make sure that it is still the run of the controller that ``identify`` saw.

        Raises
        ------
        Rebooted
            It restarted.
        """
        counts = await self._identity()
        if self._boot_id is None:
            self._boot_id = counts["BOOT_ID"]
        if counts["BOOT_ID"] != self._boot_id:
            detail = f"boot id {counts['BOOT_ID']:#x} instead of {self._boot_id:#x}"
            raise Rebooted(self.name, "check boot id", detail, "the controller restarted: call identify, check its tables, measure again")

    async def status(self) -> ControllerStatus:
        """Read the status block in one request.

        Raises
        ------
        Rebooted
            The controller restarted since ``identify``.
        LinkDown, ReplyTimeout, BadFrame
            The wire.
        """
        words = await self.link.read(reg.STATUS.base, reg.STATUS.count)
        status = reg.decode_status(words, time.monotonic())
        # The boot id is not in this block: a clock that went back, or a new connection, is the reason to ask for it.
        if self._boot_id is None or status.ctrl_us < self._last_us or self._connection != self.link.connections:
            await self.check_boot()
        self._last_us = status.ctrl_us
        return status

    async def table_format(self) -> TableFormat:
        """Read in which unit and how large this controller stores tables."""
        counts = await self._identity()
        return TableFormat(counts["TABLE_LSB_NM"], counts["BANK_SIZE"])

    async def _identity(self) -> dict[str, int]:
        words = await self.link.read(reg.IDENTITY.base, reg.IDENTITY.count)
        self._connection = self.link.connections
        counts = reg.IDENTITY.counts(words)
        check_identity(self.name, counts, reg.MAP_VERSION)
        self.fifo_size = counts["FIFO_SIZE"]
        return counts
