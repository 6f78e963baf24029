"""Register maps as data, and the pure step from 16-bit words to whole numbers (big-endian, high word first).

Also what every device with such a map has: registers that prove which map it is, and commands that carry a number and are acknowledged.
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
"""The float 1234.5 as it must stand in two registers; compared as bits, so that any word or byte order mistake shows."""
CANARY_WORDS = (0x0102, 0x0304, 0x449A, 0x5000)
"""Both as they stand in registers 0..3 of every device of docs/protocols."""


@dataclass(frozen=True, slots=True)
class Register:
    """One value of a register map.

    Parameters
    ----------
    address : int
        0-based address of its first register.
    kind : str
        How many bits, signed or not.
    name : str
        As in docs/protocols.
    per_unit : float
        Counts per unit: the physical value is count / per_unit (dividing keeps 0.01 steps exact to the last bit).
    unit : str
        The unit of the physical value.
    """

    address: int
    kind: Kind
    name: str
    per_unit: float = 1.0
    unit: str = ""


@dataclass(frozen=True, slots=True)
class RegisterBlock:
    """Registers that are read in one request, which makes them coherent.

    Parameters
    ----------
    base, count : int
        First register and number of registers of the request.
    registers : tuple of Register
        What lies in it.
    lead : int
        Registers before ``base`` that the device lets one read in the same request (ModbusLink.read says what for).
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
        """Turn the words of this block into whole numbers by name.

        Raises
        ------
        ValueError
            Another number of words than the block has.
        """
        if len(words) != self.count:
            raise ValueError(f"block at {self.base} has {self.count} registers, got {len(words)}")
        return {register.name: _count(register, words, self.base) for register in self.registers}

    def physical(self, name: str, count: int) -> float:
        """Turn a whole number of this block into its physical value, in the register's unit."""
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
_WORDS = {
    "CDAB": "the two registers of a value are swapped (CDAB)",
    "BADC": "the bytes inside a register are swapped (BADC)",
    "DCBA": "registers and bytes are swapped (DCBA)",
}
_SET_ORDER = "set the device to big-endian, high word first (ABCD)"
_WHO = "is this address and unit number really that device?"
_LONGEST_US = 100 * 365 * 86400 * 10**6


def _order(known: int, found: int) -> str:
    """Which order turns the known value into the one found; empty when none does."""
    data = known.to_bytes(4, "big")
    return next((name for name, places in _ORDERS.items() if bytes(data[i] for i in places) == found.to_bytes(4, "big")), "")


def check_identity(device: str, counts: Mapping[str, int], map_version: int) -> None:
    """Compare the canary registers and the map version with what the protocol demands.

    Parameters
    ----------
    device : str
        For the error text.
    counts : mapping
        Decoded identity block with CANARY_I32, CANARY_F32 (bits) and MAP_VER.
    map_version : int
        The version this driver was written for.

    Raises
    ------
    WrongDevice
        Not the device, another word order, or another map version.
    """
    canary, bits = counts["CANARY_I32"] & 0xFFFFFFFF, counts["CANARY_F32"]
    if canary != CANARY_I32 or bits != CANARY_F32_BITS:
        detail = f"the canary registers hold {canary:08x} {bits:08x} instead of {CANARY_I32:08x} {CANARY_F32_BITS:08x}"
        orders = {"int32": _order(CANARY_I32, canary), "float32": _order(CANARY_F32_BITS, bits)}
        named = [f"{name}: {_WORDS[order]}" for name, order in orders.items() if order]
        raise WrongDevice(device, "identify", "; ".join([detail, *named]), _SET_ORDER if named else _WHO)
    if counts["MAP_VER"] != map_version:
        detail = f"register map version {counts['MAP_VER']} instead of {map_version}"
        raise WrongDevice(device, "identify", detail, "install the matching firmware, or the matching version of this program")


def check_clock(device: str, device_us: int) -> None:
    """Refuse a 64-bit device time that no device can have: then the four registers stand in another order than the 32-bit canaries.

    Parameters
    ----------
    device_us : int
        Time since the device was switched on, us.

    Raises
    ------
    WrongDevice
        More than 100 years.
    """
    if device_us > _LONGEST_US:
        detail = f"its clock says {device_us:#018x} us since it was switched on: int64: the registers of 64-bit values are swapped"
        raise WrongDevice(device, "identify", detail, _SET_ORDER)


_POLL_S = 0.005


def next_number(acknowledged: int) -> int:
    """Return the only number the device will execute next (mod 65536)."""
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
    """Write a numbered command once and find out what became of it.

    Parameters
    ----------
    device, operation : str
        For the error text.
    number : int
        The number inside the command, ``next_number(last acknowledged)``.
    write, read_ack : callable
        Sends the command (called exactly once); reads (acknowledged number, result code).
    settle_s : float
        How long an acknowledge may take.

    Returns
    -------
    int
        The device's result code.

    Raises
    ------
    ReplyTimeout, LinkDown, BadFrame
        The write got no valid reply and the device's acknowledge says that it was not executed, or nothing could be read at all.
    """
    doubt: DriverError | None = None
    try:
        await write()
    except (ReplyTimeout, LinkDown, BadFrame) as error:
        doubt = error
    acknowledged, result = await _last_ack(number, read_ack, settle_s)
    if acknowledged == number:
        return result
    if doubt is not None:
        doubt.add_note(f"asked afterwards, the device says that command {number} was not executed (last executed: {acknowledged})")
        raise doubt
    detail = f"command {number} is not acknowledged (last executed: {acknowledged})"
    raise ReplyTimeout(device, operation, detail, "is another program sending commands to this device?")


async def _last_ack(number: int, read_ack: Callable[[], Awaitable[tuple[int, int]]], settle_s: float) -> tuple[int, int]:
    clock = asyncio.get_running_loop().time
    until = clock() + settle_s
    while True:
        acknowledged, result = await read_ack()
        if acknowledged == number or clock() >= until:
            return acknowledged, result
        await asyncio.sleep(_POLL_S)
