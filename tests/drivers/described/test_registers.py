"""Numbers in registers, in the four byte orders, and units of the wire in millimetres, degrees and seconds."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from abbe.drivers.described.registers import ORDERS, decode, encode, ours
from abbe.drivers.device_file import SIZE, DeviceValue

# As manuals of devices show them: 0x12345678, the float 1234.5 (0x449A5000), and the 64-bit 0x0102030405060708.
KNOWN = [
    ("u32", 0x12345678, {"ABCD": "1234 5678", "CDAB": "5678 1234", "BADC": "3412 7856", "DCBA": "7856 3412"}),
    ("f32", 1234.5, {"ABCD": "449a 5000", "CDAB": "5000 449a", "BADC": "9a44 0050", "DCBA": "0050 9a44"}),
    ("i16", -2, {"ABCD": "fffe", "CDAB": "fffe", "BADC": "feff", "DCBA": "feff"}),
    ("u64", 0x0102030405060708, {"ABCD": "0102 0304 0506 0708", "CDAB": "0708 0506 0304 0102", "DCBA": "0807 0605 0403 0201"}),
]


@pytest.mark.parametrize(("kind", "number", "orders"), KNOWN)
def test_known_numbers(kind, number, orders):
    for order, text in orders.items():
        words = tuple(int(word, 16) for word in text.split())
        assert decode(words, kind, order) == number
        assert encode(number, kind, order) == words


@given(st.data(), st.sampled_from(ORDERS), st.sampled_from(sorted(SIZE)))
def test_every_number_of_every_type_comes_back(data, order, kind):
    bits = 16 * SIZE[kind]
    low = -(1 << bits - 1) if kind[0] == "i" else 0
    number = data.draw(st.floats(width=bits, allow_nan=False) if kind[0] == "f" else st.integers(low, low + (1 << bits) - 1))
    assert decode(encode(number, kind, order), kind, order) == number


@pytest.mark.parametrize(("kind", "number"), [("u16", 65536), ("u16", -1), ("i16", 32768), ("u32", 1 << 32), ("f32", 1e39)])
def test_a_number_that_does_not_fit_is_refused(kind, number):
    with pytest.raises(ValueError, match=f"is no {kind}"):
        encode(number, kind, "ABCD")


@pytest.mark.parametrize(
    ("unit", "count", "expected"),
    [
        ("nm", 1e6, 1.0),
        ("um", 1e3, 1.0),
        ("in", 1.0, 25.4),
        ("degF", 68.0, 20.0),
        ("degF", 32.0, 0.0),
        ("hPa", 1013.25, 101325.0),
        ("ms", 5.0, 5e-3),
    ],
)
def test_units(unit, count, expected):
    assert ours(DeviceValue(unit=unit), count) == pytest.approx(expected)
    assert ours(DeviceValue(unit=unit, sign=-1, offset=0.0, scale=0.5), -2.0 * count) == pytest.approx(expected)
    assert math.isnan(ours(DeviceValue(unit=unit), float("nan")))
