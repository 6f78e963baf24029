"""Register maps as data, and the pure step from 16-bit words to whole numbers (big-endian, high word first)."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

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
