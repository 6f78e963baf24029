"""A described device on Modbus TCP or RTU."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterable

from abbe.drivers.api import DeviceInfo
from abbe.drivers.described.registers import ORDERS, decode, encode, registers
from abbe.drivers.described.source import CountSnapshot, RequestPacer
from abbe.drivers.device_file import SIZE, Command, DeviceFile, DeviceValue, IdentityRegisters, Order, core_values
from abbe.drivers.errors import Rebooted, ReplyTimeout, WrongDevice
from abbe.drivers.links.modbus_link import Canary, ModbusLink, ModbusOperation
from abbe.drivers.links.words import next_number, run_numbered

_POLL_S = 0.02
ORDER_NAMES = {
    "ABCD": "high register first",
    "CDAB": "low register first",
    "BADC": "high register first, bytes of a register swapped",
    "DCBA": "low register first, bytes of a register swapped",
}


def canary_of(file: DeviceFile) -> Canary | None:
    """Return the canary that verifies an RTU line: the first known content of at least two registers; None if there is none."""
    table = file.modbus
    known = next((one for one in file.identity if SIZE[one.type] > 1), None)
    if table is None or known is None:
        return None
    words = encode(known.holds, known.type, known.order or table.order)
    return Canary(known.address, words, len(words), (table.function,))


class ModbusSource:
    """Registers of a described device. The values that belong together are read with one request."""

    def __init__(self, file: DeviceFile, link: ModbusLink) -> None:
        assert file.modbus is not None
        self._file, self._link, self._table = file, link, file.modbus
        self.name, self.incidents = link.name, link.incidents
        self._pace = RequestPacer(file.limits.rate_hz)
        self._core = core_values(file)
        self._number = 0
        self._connection = -1
        self._boot: float | None = None
        self._epoch = 0

    async def identify(self) -> DeviceInfo:
        """Compare the identity registers, and remember the present content of the boot registers, which a restart changes.

        Raises
        ------
        WrongDevice
            The identity registers hold something else; the message names the byte order in which they would fit.
        LinkDown, ReplyTimeout, BadFrame, Refused, DeviceFault
            Communication failed.
        """
        await self._check_identity()
        self._boot = await self._optional(self._file.boot)
        serial = await self._optional(self._file.serial_no)
        self._connection = self._link.connections
        self.incidents.accepted()
        return DeviceInfo(self._file.kind, self._file.name, "" if serial is None else f"{serial:.0f}", int(self._boot or 0), "")

    async def snapshot(self) -> CountSnapshot:
        """Read all values. After a new connection the identity is compared first, because the device may be another one.

        Raises
        ------
        Rebooted
            The device restarted.
        WrongDevice, LinkDown, ReplyTimeout, BadFrame, Refused, DeviceFault
            Another device, or communication failed.
        """
        await self._pace.turn()
        words = await self._read(self._core)
        arrived_s = time.monotonic()
        for name in self._file.values.keys() - self._core.keys():
            words |= await self._read({name: self._file.values[name]})
        if self._connection != self._link.connections:
            await self._same_device()
        self._number += 1
        counts = {name: decode(found, self._file.values[name].type, self._order(self._file.values[name])) for name, found in words.items()}
        return CountSnapshot(arrived_s, self._number, counts, words, self._epoch)

    async def command(self, command: Command, operation: str) -> None:
        """Send a command once and wait for its acknowledgement.

        Raises
        ------
        ReplyTimeout
            The command is not acknowledged.
        LinkDown, BadFrame, Refused, DeviceFault
            Communication failed, or the device refused it.
        """
        assert command.address is not None
        address, registered = command.address, command.numbered
        if registered is not None:
            number = next_number(await self._one(registered, command.function))

            async def acknowledged() -> tuple[int, int]:
                return await self._one(registered, command.function), 0

            async def write() -> None:
                await self._write(address, (number, *command.write), ModbusOperation.NUMBERED)

            await run_numbered(self.name, operation, number, write, acknowledged, settle_s=command.within_s)
        else:
            await self._write(address, command.write, ModbusOperation.TRIGGER)
        if command.acknowledge is not None:
            await self._becomes(command, command.acknowledge, operation)

    async def close(self) -> None:
        """Close the link. Closing twice does nothing."""
        await self._link.close()

    async def _becomes(self, command: Command, address: int, operation: str) -> None:
        clock = asyncio.get_running_loop().time
        until_s = clock() + command.within_s
        while (found := await self._one(address, command.function)) != command.becomes:
            if clock() > until_s:
                detail = f"not acknowledged: register {address} holds {found}, not {command.becomes}, after {command.within_s:g} s"
                raise ReplyTimeout(
                    self.name, operation, detail, "check that the device allows this command, and correct it in the device file"
                )
            await asyncio.sleep(_POLL_S)

    async def _same_device(self) -> None:
        await self._check_identity()
        boot = await self._optional(self._file.boot)
        if boot != self._boot and self._boot is not None:
            error = Rebooted(self.name, "read", "the device restarted", "connect again, zero the device, then measure this test again")
            self.incidents.note(error, latched=True)
            raise error
        self._epoch += boot is None
        self._connection = self._link.connections

    async def _check_identity(self) -> None:
        for known in self._file.identity:
            words = await self._registers(known.address, SIZE[known.type])
            order = known.order or self._table.order
            if words != encode(known.holds, known.type, order):
                error = WrongDevice(self.name, "identify", *_why(known, words, order))
                self.incidents.note(error, latched=True)
                raise error

    async def _optional(self, value: DeviceValue | None) -> float | None:
        if value is None or value.address is None:
            return None
        return decode(await self._registers(value.address, registers(value)), value.type, self._order(value))

    async def _read(self, values: dict[str, DeviceValue]) -> dict[str, tuple[int, ...]]:
        first, end = span(values.values())
        words = await self._registers(first, end - first)
        at = {name: (value.address or 0) - first for name, value in values.items()}
        return {name: words[at[name] : at[name] + registers(value)] for name, value in values.items()}

    async def _registers(self, address: int, count: int) -> tuple[int, ...]:
        return await self._link.read(address, count, function=self._table.function)

    async def _one(self, address: int, function: int) -> int:
        return (await self._link.read(address, 1, function=function))[0]

    async def _write(self, address: int, words: tuple[int, ...], op: ModbusOperation) -> None:
        await self._link.write(address, words, op, function=self._table.write_function)

    def _order(self, value: DeviceValue) -> Order:
        return value.order or self._table.order


def span(values: Iterable[DeviceValue]) -> tuple[int, int]:
    """Return the first register of some values, and the register after their last register."""
    listed = [(value.address or 0, (value.address or 0) + registers(value)) for value in values]
    return min(first for first, _ in listed), max(end for _, end in listed)


def _why(known: IdentityRegisters, words: tuple[int, ...], order: Order) -> tuple[str, str]:
    """Return detail and remedy for registers that hold something else than the device file says."""
    found = decode(words, known.type, order)
    fits = [other for other in ORDERS if other != order and words == encode(known.holds, known.type, other)]
    shown = " ".join(f"{word:04x}" for word in words)
    detail = f"register {known.address} holds {found:.10g} ({shown}), the device file says {known.holds:.10g}"
    if fits:
        return (
            f"{detail}: its byte order is {fits[0]} ({ORDER_NAMES[fits[0]]}), not {order}",
            f'write order = "{fits[0]}" in the device file',
        )
    return detail, "check address, unit number and device file: one of them belongs to another device"
