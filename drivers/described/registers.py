"""Converts Modbus registers, in any of the four byte orders of devices, to values, and units of the wire to ours (`abbe.drivers.api`)."""

from __future__ import annotations

import struct
from collections.abc import Sequence

from abbe.drivers.device_file import SIZE, DeviceValue, Order, Type, Unit
from abbe.drivers.links.words import bytes_of, words_of

ORDERS: tuple[Order, ...] = ("ABCD", "CDAB", "BADC", "DCBA")
_FORMAT: dict[Type, str] = {"u16": "H", "i16": "h", "u32": "I", "i32": "i", "f32": "f", "u64": "Q", "i64": "q", "f64": "d"}
TO_OURS: dict[Unit, tuple[float, float]] = {
    "nm": (1e-6, 0.0), "um": (1e-3, 0.0), "mm": (1.0, 0.0), "in": (25.4, 0.0), "degC": (1.0, 0.0), "degF": (5.0 / 9.0, -32.0 * 5.0 / 9.0),
    "Pa": (1.0, 0.0), "hPa": (100.0, 0.0), "%": (1.0, 0.0), "permille": (1.0, 0.0), "us": (1e-6, 0.0), "ms": (1e-3, 0.0), "s": (1.0, 0.0),
    "1": (1.0, 0.0),
}  # fmt: skip
"""Factor and offset to mm, degree C, Pa, s."""


def _ordered(data: bytes, order: Order) -> bytes:
    """Bring the bytes of a value into big-endian order, or back: every order is its own inverse."""
    words = [data[k : k + 2] for k in range(0, len(data), 2)]
    if order in ("CDAB", "DCBA"):
        words.reverse()
    return b"".join(word[::-1] for word in words) if order in ("BADC", "DCBA") else b"".join(words)


def decode(words: Sequence[int], kind: Type, order: Order) -> float:
    """Return the number in the registers of one value. An integer type gives an int, so that its bits can be read."""
    number: float = struct.unpack(f">{_FORMAT[kind]}", _ordered(bytes_of(words), order))[0]
    return number


def encode(number: float, kind: Type, order: Order) -> tuple[int, ...]:
    """Return the registers of one value. Raises ValueError for a number that the type cannot hold."""
    try:
        return words_of(_ordered(struct.pack(f">{_FORMAT[kind]}", number if kind[0] == "f" else int(number)), order))
    except (struct.error, OverflowError):
        raise ValueError(f"{number} is no {kind}") from None


def scaled(value: DeviceValue, count: float) -> float:
    """Return a count in the unit of the device file."""
    return value.sign * value.scale * count + value.offset


def ours(value: DeviceValue, count: float) -> float:
    """Return a count in our unit: mm, degree C, Pa, s, % or permille."""
    factor, offset = TO_OURS[value.unit]
    return factor * scaled(value, count) + offset


def registers(value: DeviceValue) -> int:
    """Number of registers of a value."""
    return SIZE[value.type]
