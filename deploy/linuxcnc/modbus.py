"""A Modbus TCP server that needs only the standard library, so nothing has to be installed on the control's computer."""

from __future__ import annotations

import asyncio
import socket
import struct
from contextlib import suppress
from typing import Protocol

READ_MAX, WRITE_MAX = 125, 123
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE = 1, 2, 3
_MBAP = struct.Struct(">HHHB")


class Registers(Protocol):
    """The registers to serve: words at addresses."""

    def read(self, address: int, count: int) -> list[int] | None:
        """Return the words of one read request; None for addresses that do not exist."""

    def write(self, address: int, words: list[int]) -> bool:
        """Execute one write request; return False for addresses that cannot be written."""


class Fault(Exception):  # noqa: N818 - Modbus calls it an exception code, and this is one
    """The reply to the request is an exception code."""


def answer(registers: Registers, pdu: bytes) -> bytes:
    """Return the reply to one request with function code 3, 4, 6 or 16."""
    function = pdu[0]
    try:
        if function in (3, 4):
            return pdu[:1] + _read(registers, pdu)
        if function == 6:
            address, word = _unpack(">HH", pdu[1:])
            return _written(registers, address, [word], pdu)
        if function == 16:
            address, count, size = _unpack(">HHB", pdu[1:6])
            if not 1 <= count <= WRITE_MAX or size != 2 * count:
                raise Fault(ILLEGAL_VALUE)
            return _written(registers, address, list(_unpack(f">{count}H", pdu[6:])), pdu)
        raise Fault(ILLEGAL_FUNCTION)
    except Fault as fault:
        return bytes([function | 0x80, fault.args[0]])


def _read(registers: Registers, pdu: bytes) -> bytes:
    address, count = _unpack(">HH", pdu[1:])
    if not 1 <= count <= READ_MAX:
        raise Fault(ILLEGAL_VALUE)
    words = registers.read(address, count)
    if words is None:
        raise Fault(ILLEGAL_ADDRESS)
    return struct.pack(f">B{count}H", 2 * count, *words)


def _written(registers: Registers, address: int, words: list[int], pdu: bytes) -> bytes:
    if not registers.write(address, words):
        raise Fault(ILLEGAL_ADDRESS)
    return pdu[:5]


def _unpack(layout: str, data: bytes) -> tuple[int, ...]:
    try:
        return struct.unpack(layout, data)
    except struct.error:
        raise Fault(ILLEGAL_VALUE) from None


async def serve(registers: Registers, listening: socket.socket) -> asyncio.Server:
    """Answer requests to unit 1 (or 0, or 255) on a listening socket; requests of all clients are executed one after the other."""

    async def client(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(OSError, asyncio.IncompleteReadError):
            while True:
                number, protocol, length, unit = _MBAP.unpack(await reader.readexactly(7))
                if protocol != 0 or not 2 <= length <= 254:
                    break  # not Modbus: where the next request begins is unknown
                pdu = await reader.readexactly(length - 1)
                if unit not in (0, 1, 255):
                    continue
                reply = answer(registers, pdu)
                writer.write(_MBAP.pack(number, 0, len(reply) + 1, unit) + reply)
                await writer.drain()
        writer.close()

    return await asyncio.start_server(client, sock=listening)
