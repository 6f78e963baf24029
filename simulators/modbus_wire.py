"""Modbus servers (TCP, RTU): the only simulator file that uses pymodbus. A register map provides the words, pymodbus transports them."""

import asyncio
import logging
from typing import Protocol

from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusSerialServer, ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

logging.getLogger("pymodbus").setLevel(logging.ERROR)  # a taken port raises an exception; pymodbus would log it as well

_READ = (3, 4)
_WRITE = (6, 16)


class RegisterMap(Protocol):
    """Registers of a device. ``None`` from `read` and ``False`` from `write` mean an illegal address (exception 2)."""

    size: int
    """Number of registers from address 0 on."""

    def read(self, address: int, count: int) -> list[int] | None:
        """Return the current words of ``count`` registers."""
        ...

    def write(self, address: int, values: list[int]) -> bool:
        """Take the words of one write request."""
        ...


def _device(registers: RegisterMap, unit: int) -> SimDevice:
    """Return a pymodbus device that passes each request to the register map."""

    async def action(
        function: int, start: int, address: int, count: int, block: list[int], values: list[int] | list[bool] | None
    ) -> ExcCodes | None:
        if function in _READ:
            words = registers.read(address, count)
            if words is None:
                return ExcCodes.ILLEGAL_ADDRESS
            block[address - start : address - start + count] = words
            return None
        if function not in _WRITE:
            return ExcCodes.ILLEGAL_FUNCTION
        if values is None:  # pymodbus fetches the echo of an FC6: the block has just taken it
            return None
        return None if registers.write(address, [int(v) for v in values]) else ExcCodes.ILLEGAL_ADDRESS

    return SimDevice(id=unit, simdata=[SimData(0, count=registers.size, values=0, datatype=DataType.REGISTERS)], action=action)


class ModbusTcp:
    """A Modbus TCP server on 127.0.0.1."""

    def __init__(self, registers: RegisterMap, *, unit: int = 1) -> None:
        self._registers, self._unit = registers, unit
        self._server: ModbusTcpServer | None = None

    async def start(self, port: int) -> int:
        """Listen and return the port (any free one for 0). Raises OSError when the port is taken."""
        self._server = ModbusTcpServer(_device(self._registers, self._unit), address=("127.0.0.1", port))
        try:
            await self._server.serve_forever(background=True)
        except RuntimeError as exc:  # pymodbus has logged and swallowed the OSError
            raise OSError(f"cannot listen on 127.0.0.1:{port}") from exc
        listener = self._server.transport
        return int(listener.sockets[0].getsockname()[1]) if isinstance(listener, asyncio.Server) else port

    @property
    def connected(self) -> bool:
        """Whether any host is connected."""
        return self._server is not None and bool(self._server.active_connections)

    async def stop(self) -> None:
        """Close the listener and its connections."""
        if self._server is not None:
            await self._server.shutdown()  # type: ignore[no-untyped-call]


class ModbusRtu:
    """A Modbus RTU server on a serial line."""

    def __init__(self, registers: RegisterMap, *, unit: int = 1) -> None:
        self._registers, self._unit = registers, unit
        self._server: ModbusSerialServer | None = None

    async def start(self, path: str, baud: int) -> None:
        """Open the line and serve it."""
        self._server = ModbusSerialServer(_device(self._registers, self._unit), port=path, baudrate=baud, ignore_missing_devices=True)
        try:
            await self._server.serve_forever(background=True)
        except RuntimeError as exc:
            raise OSError(f"cannot serve {path}") from exc

    async def stop(self) -> None:
        """Close the line."""
        if self._server is not None:
            await self._server.shutdown()  # type: ignore[no-untyped-call]
