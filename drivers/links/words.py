"""Register maps as data, and the pure conversion from 16-bit words to integers (big-endian, high word first).

This module also contains the common parts of all devices with such a map: registers that identify the map, and numbered commands with an
acknowledge.
"""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from abbe.drivers.errors import BadFrame, DriverError, LinkDown, ReplyTimeout, WrongDevice

Kind = Literal["u16", "i16", "u32", "i32", "u64", "i64"]
_SIZE: dict[Kind, int] = {"u16": 1, "i16": 1, "u32": 2, "i32": 2, "u64": 4, "i64": 4}

CANARY_I32 = 0x01020304
CANARY_F32_BITS = 0x449A5000
"""Bits of the float 1234.5 in two registers. Bits are compared, so that any mistake in word or byte order shows."""
CANARY_WORDS = (0x0102, 0x0304, 0x449A, 0x5000)
"""Both canaries in registers 0..3 of every device of docs/protocols."""


@dataclass(frozen=True, slots=True)
class Register:
    """One value of a register map.

    ``address``: first register, from 0; ``name``: name in docs/protocols; ``per_unit``: counts per ``unit``, so that the physical value
    is count / per_unit (a division keeps 0.01 steps exact to the last bit).
    """

    address: int
    kind: Kind
    name: str
    per_unit: float = 1.0
    unit: str = ""


@dataclass(frozen=True, slots=True)
class RegisterBlock:
    """Registers read in one request, which makes them coherent.

    ``base``, ``count``: first register and number of registers of the request; ``registers``: the values in them; ``lead``: number of
    registers before ``base`` that the same request may read, too (see ``ModbusLink.read``).
    """

    base: int
    count: int
    registers: tuple[Register, ...]
    lead: int = 0
    _by_name: dict[str, Register] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for register in self.registers:
            first = register.address - self.base
            if not (first >= 0 and first + _SIZE[register.kind] <= self.count):
                raise ValueError(f"{register.name} lies outside registers {self.base}..{self.base + self.count - 1}")
        object.__setattr__(self, "_by_name", {register.name: register for register in self.registers})

    def counts(self, words: Sequence[int]) -> dict[str, int]:
        """Convert the words of this block to integers by name. Raises ValueError for a wrong number of words."""
        if len(words) != self.count:
            raise ValueError(f"block at {self.base} has {self.count} registers, got {len(words)}")
        return {register.name: _count(register, words, self.base) for register in self.registers}

    def physical(self, name: str, count: int) -> float:
        """Convert a count of this block to its physical value, in the register's unit."""
        return count / self._by_name[name].per_unit


def _count(register: Register, words: Sequence[int], base: int) -> int:
    first, size = register.address - base, _SIZE[register.kind]
    value = 0
    for word in words[first : first + size]:
        value = value << 16 | word
    if register.kind[0] == "i" and value >> (16 * size - 1):
        value -= 1 << 16 * size
    return value


def words_of(data: bytes) -> tuple[int, ...]:
    """Cut big-endian bytes into 16-bit words; the length must be even."""
    return struct.unpack(f">{len(data) // 2}H", data)


def bytes_of(words: Sequence[int]) -> bytes:
    """Join 16-bit words to big-endian bytes."""
    return struct.pack(f">{len(words)}H", *words)


_ORDERS = {"CDAB": (2, 3, 0, 1), "BADC": (1, 0, 3, 2), "DCBA": (3, 2, 1, 0)}
_ORDER_NAMES = {
    "CDAB": "the two registers of a value are swapped (CDAB)",
    "BADC": "the bytes inside a register are swapped (BADC)",
    "DCBA": "registers and bytes are swapped (DCBA)",
}
_SET_ORDER = "set the device to big-endian, high word first (ABCD)"
_WHO = "check address and unit number: they may belong to another device"
_LONGEST_US = 100 * 365 * 86400 * 10**6
_HOUR_US = 3600 * 10**6
_STANDS_S = 1.0


def _order(known: int, found: int) -> str:
    """Return the byte order (``"CDAB"``, ...) that turns the known value into the found value; empty if no order does."""
    data = known.to_bytes(4, "big")
    return next((name for name, places in _ORDERS.items() if bytes(data[i] for i in places) == found.to_bytes(4, "big")), "")


def check_identity(device: str, counts: Mapping[str, int], map_version: int) -> None:
    """Check the canary registers and the map version.

    ``counts``: decoded identity block with CANARY_I32, CANARY_F32 (bits) and MAP_VER.

    Raises
    ------
    WrongDevice
        Another device, word order, or map version.
    """
    canary, bits = counts["CANARY_I32"] & 0xFFFFFFFF, counts["CANARY_F32"]
    if canary != CANARY_I32 or bits != CANARY_F32_BITS:
        detail = f"the check registers (canary) hold {canary:08x} {bits:08x} instead of {CANARY_I32:08x} {CANARY_F32_BITS:08x}"
        orders = {"int32": _order(CANARY_I32, canary), "float32": _order(CANARY_F32_BITS, bits)}
        named = [f"{name}: {_ORDER_NAMES[order]}" for name, order in orders.items() if order]
        raise WrongDevice(device, "identify", "; ".join([detail, *named]), _SET_ORDER if named else _WHO)
    if counts["MAP_VER"] != map_version:
        detail = f"register map version {counts['MAP_VER']} instead of {map_version}"
        raise WrongDevice(device, "identify", detail, "install the matching firmware, or the matching version of this program")


async def check_clock(device: str, read_us: Callable[[], Awaitable[int]]) -> None:
    """Check the order of the four registers of a device's clock. ``read_us`` returns the time since the device was switched on, us.

    A clock in the wrong order shows more than 100 years. About one reading in several hundred is possible in both orders:
    then the next reading that differs must be at most an hour later.

    Raises
    ------
    WrongDevice
        The registers are in the wrong order.
    DriverError
        Raised by ``read_us``.
    """
    first_us = last_us = await read_us()
    if 0 < first_us <= _LONGEST_US and min(_reversed(first_us)) <= _LONGEST_US:
        last_us = await _next_reading(read_us, first_us)
    if first_us > _LONGEST_US or not 0 <= last_us - first_us <= _HOUR_US:
        detail = f"its clock reads {last_us:#018x} us since it was switched on: the registers of 64-bit values are swapped"
        raise WrongDevice(device, "identify", detail, _SET_ORDER)


def _reversed(clock_us: int) -> tuple[int, int]:
    data = clock_us.to_bytes(8, "big")
    words = [data[at : at + 2] for at in range(0, 8, 2)]
    return int.from_bytes(b"".join(words[::-1]), "big"), int.from_bytes(data[::-1], "big")


async def _next_reading(read_us: Callable[[], Awaitable[int]], first_us: int) -> int:
    """Return the next reading that differs, or the same one if the clock stands still."""
    clock = asyncio.get_running_loop().time
    until_s = clock() + _STANDS_S
    while (read := await read_us()) == first_us and clock() < until_s:  # noqa: ASYNC110 - the device does not signal a new reading
        await asyncio.sleep(_POLL_S)
    return read


_POLL_S = 0.005


def next_number(acknowledged: int) -> int:
    """Return the only command number that the device will accept next (mod 65536)."""
    return (acknowledged + 1) & 0xFFFF


async def run_numbered(
    device: str,
    operation: str,
    number: int,
    write: Callable[[], Awaitable[None]],
    read_ack: Callable[[], Awaitable[tuple[int, int]]],
    *,
    settle_s: float = 1.0,
) -> int:
    """Write a numbered command once, determine its outcome, and return the device's result code.

    Parameters
    ----------
    number : int
        Number of the command: `next_number` of the last acknowledged one.
    write, read_ack : callable
        ``write`` sends the command (called exactly once); ``read_ack`` returns (acknowledged number, result code).
    settle_s : float
        Longest wait for the acknowledge.

    Raises
    ------
    ReplyTimeout, LinkDown, BadFrame
        The write got no valid reply, and the acknowledge shows no execution or is unreadable.
    """
    write_error: DriverError | None = None
    try:
        await write()
    except (ReplyTimeout, LinkDown, BadFrame) as error:
        write_error = error
    acknowledged, result = await _last_ack(number, read_ack, settle_s)
    if acknowledged == number:
        return result
    if write_error is not None:
        write_error.add_note(f"afterwards the acknowledge shows that command {number} was not executed (last executed: {acknowledged})")
        raise write_error
    detail = f"command {number} is not acknowledged (last executed: {acknowledged})"
    raise ReplyTimeout(device, operation, detail, "end every other program that sends commands to this device")


async def _last_ack(number: int, read_ack: Callable[[], Awaitable[tuple[int, int]]], settle_s: float) -> tuple[int, int]:
    clock = asyncio.get_running_loop().time
    until = clock() + settle_s
    while True:
        acknowledged, result = await read_ack()
        if acknowledged == number or clock() >= until:
            return acknowledged, result
        await asyncio.sleep(_POLL_S)
