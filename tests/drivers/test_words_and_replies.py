"""Register words to numbers, and the comparison of a Modbus reply with its request."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from abbe.drivers.cnc import registers as cnc
from abbe.drivers.errors import WrongDevice
from abbe.drivers.laser import driver as laser
from abbe.drivers.links import words
from abbe.drivers.links.modbus import rtu_mismatch, tcp_mismatch
from abbe.drivers.links.words import Register, RegisterBlock, bytes_of, check_clock, check_identity, words_of

READ = bytes.fromhex("0007 0000 0006 01 03 0064 0002")
WRITE = bytes.fromhex("0008 0000 000B 01 10 0064 0002 04 0001 0002")


@given(st.integers(-(2**63), 2**63 - 1), st.integers(-(2**31), 2**31 - 1), st.integers(-(2**15), 2**15 - 1), st.integers(0, 2**64 - 1))
def test_signed_and_unsigned_words(i64, i32, i16, u64):
    block = RegisterBlock(10, 12, (Register(10, "i64", "A"), Register(14, "i32", "B"), Register(16, "i16", "C"), Register(18, "u64", "D")))
    words = words_of(struct.pack(">qihxxQ", i64, i32, i16, u64))
    assert block.counts(words) == {"A": i64, "B": i32, "C": i16, "D": u64}


@given(st.lists(st.integers(0, 0xFFFF)))
def test_words_and_bytes(words):
    assert list(words_of(bytes_of(words))) == words


def test_blocks_guard_their_edges():
    with pytest.raises(ValueError, match="outside"):
        RegisterBlock(10, 2, (Register(11, "u32", "X"),))
    with pytest.raises(ValueError, match="18 registers"):
        laser.READING.counts((0,) * 17)


@pytest.mark.parametrize("block", [cnc.IDENTITY, cnc.STATUS, cnc.COMP_STATUS, laser.IDENTITY, laser.READING])
def test_no_two_registers_overlap(block):
    size = {"u16": 1, "i16": 1, "u32": 2, "i32": 2, "u64": 4, "i64": 4}
    taken = [r.address + k for r in block.registers for k in range(size[r.kind])]
    assert len(taken) == len(set(taken))


def test_position_counts_are_exact_and_bounded():
    assert cnc.position_counts((0.1, -0.3, 1234.56789)) == (10_000, -30_000, 123_456_789)
    for bad in (float("nan"), float("inf"), 21_001.0):
        with pytest.raises(ValueError, match="position"):
            cnc.position_counts((0.0, bad, 0.0))


@pytest.mark.parametrize("feed", [float("nan"), -1.0, 1e9])
def test_impossible_feeds(feed):
    with pytest.raises(ValueError, match="feed"):
        cnc.encode_motion(1, cnc.MOVE, feed_mm_min=feed)


def test_impossible_chunks_and_commands():
    for n in (0, 20):
        with pytest.raises(ValueError, match="chunk"):
            cnc.encode_fifo(1, [(0, 0, 0)] * n)
    with pytest.raises(ValueError, match="compensation"):
        cnc.encode_comp(1, 2, owner=2**32)


def test_interlocks_in_words():
    ready = cnc.Bit.REMOTE | cnc.Bit.REFERENCED | cnc.Bit.DRIVES_ON
    assert cnc.interlocks(cnc.conditions_of(ready | cnc.Bit.IN_POSITION | cnc.Bit.FEED_HOLD)) == []
    assert cnc.interlocks(cnc.conditions_of(ready | cnc.Bit.DOOR_OPEN)) == ["the door is open"]
    assert len(cnc.interlocks(cnc.conditions_of(cnc.Bit.ESTOP | cnc.Bit.DOOR_OPEN | cnc.Bit.ALARM | cnc.Bit.NC_PROGRAM))) == 7


GOOD = {"CANARY_I32": 0x01020304, "CANARY_F32": 0x449A5000, "MAP_VER": 1}


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"CANARY_I32": 0x03040102}, "two registers of a value are swapped"),
        ({"CANARY_I32": 0x02010403}, "bytes inside a register are swapped"),
        ({"CANARY_I32": 0}, "may belong to another device"),
        ({"CANARY_F32": 0x5000449A}, "5000449a"),
        ({"MAP_VER": 2}, "version 2 instead of 1"),
    ],
)
def test_wrong_devices(change, why):
    check_identity("dev", GOOD, 1)
    with pytest.raises(WrongDevice, match=why):
        check_identity("dev", GOOD | change, 1)


@given(st.sampled_from([READ, WRITE]), st.binary(max_size=300))
def test_any_bytes_can_be_compared(sent, heard):
    assert isinstance(tcp_mismatch(sent, heard), str)
    assert isinstance(rtu_mismatch(sent[6:] + b"\x00\x00", heard), str)


@pytest.mark.parametrize(
    ("sent", "answer"),
    [
        (READ, "0007 0000 0007 01 03 04 0001 0002"),
        (READ, "0007 0000 0003 01 83 02"),
        (WRITE, "0008 0000 0006 01 10 0064 0002"),
        (WRITE, "0008 0000 0003 01 90 06"),
    ],
)
def test_a_good_reply_fits_at_every_length_and_any_change_of_a_fixed_byte_does_not(sent, answer):
    good = bytes.fromhex(answer)
    for size in range(len(good) + 1):
        assert tcp_mismatch(sent, good[:size]) == ""
        assert rtu_mismatch(sent[6:] + b"\x00\x00", good[6 : 6 + size]) == ""
    data_from = 9 if good[7] == 3 else 8 if good[7] & 0x80 else len(good)
    for index in range(data_from):
        for bit in range(8):
            damaged = bytearray(good)
            damaged[index] ^= 1 << bit
            assert tcp_mismatch(sent, bytes(damaged)) != ""
    assert "too many" in tcp_mismatch(sent, good + b"\x00")
    assert "too many" in rtu_mismatch(sent[6:] + b"\x00\x00", good[6:] + b"\x00\x00\x00")


ORDERS = {
    "ABCD": lambda data: data,
    "CDAB": lambda data: b"".join(data[at : at + 2] for at in (6, 4, 2, 0)),
    "DCBA": lambda data: data[::-1],
}


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("clock_us", [3_000_000, 2_999_808, 0x0B00_0100, 0x0001_0000, 40 * 365 * 86400 * 10**6], ids=hex)
async def test_a_clock_in_the_wrong_order_is_refused_even_if_one_reading_is_possible(order, clock_us):
    shown = iter([clock_us, clock_us, clock_us + 50_000, clock_us + 100_000])

    async def read_us() -> int:
        return int.from_bytes(ORDERS[order](next(shown).to_bytes(8, "big")), "big")

    if order == "ABCD":
        await check_clock("laser", read_us)
        return
    with pytest.raises(WrongDevice, match="64-bit values are swapped"):
        await check_clock("laser", read_us)


async def test_a_clock_that_stands_still_says_nothing_of_its_order(monkeypatch):
    monkeypatch.setattr(words, "_STANDS_S", 0.0)

    async def read_us() -> int:
        return 0x0001_0000

    await check_clock("laser", read_us)
