"""The bank image: exact round trip, refusals, and a second decoder that agrees without sharing code."""

from __future__ import annotations

import zlib
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from abbe.drivers import second_decoder as second
from abbe.drivers import tables
from abbe.drivers.tables import TableCodecError, TableImage

positions = st.integers(-(2**31), 2**31 - 1).map(lambda n: n / 100_000)
pitches = st.integers(1, 2**31 - 1).map(lambda n: n / 100_000)


@st.composite
def images(draw, kinds=(0, 1, 2)):
    kind = draw(st.sampled_from(kinds))
    counts = (0, 0, 0) if kind == 0 else tuple(draw(st.integers(2, 6)) for _ in range(3))
    size = tables.body_words(kind, counts)
    return TableImage(
        kind,
        draw(st.integers(0, 2**32 - 1)),
        draw(st.integers(1, 0xFFFF)),
        tuple(draw(positions) for _ in range(3)),
        tuple(draw(pitches) for _ in range(3)),
        counts,
        tuple(draw(st.lists(st.integers(-32768, 32767), min_size=size, max_size=size))),
    )


SMALL = TableImage(1, 0xDEADBEEF, 100, (-100.0, 0.0, 5.0), (50.0, 25.0, 0.00001), (3, 2, 2), tuple(range(-10, 11)))


def test_small_image_word_by_word():
    data = tables.encode(SMALL)
    words = [int.from_bytes(data[i : i + 2], "big") for i in range(0, len(data), 2)]
    assert words[:12] == [0xABBE, 1, 1, 45, 0xDEAD, 0xBEEF, 100, 0, 3, 2, 2, 0]
    assert words[12:18] == [0xFF67, 0x6980, 0, 0, 0x0007, 0xA120]
    assert words[18:24] == [0x004C, 0x4B40, 0x0026, 0x25A0, 0, 1]
    assert words[24:26] == [0xFFF6, 0xFFF7]
    assert words[44] == 10


@given(images())
def test_round_trip(image):
    data = tables.encode(image)
    assert tables.decode(data) == image
    assert tables.crc32(data) == zlib.crc32(data) == second.plain_crc32(data)


@given(images(kinds=(0, 1)))
def test_second_decoder_agrees_on_axis_tables(image):
    read = second.read_axis_tables(tables.encode(image))
    if image.kind == 0:
        assert read == {}
        return
    index = 0
    for axis, name_in in enumerate("XYZ"):
        for name_out in "XYZ":
            column = read[name_in, name_out]
            assert len(column) == image.counts[axis]
            for i, (position, correction) in enumerate(column):
                assert position == pytest.approx(image.start_mm[axis] + i * image.step_mm[axis], abs=1e-6)
                assert correction == pytest.approx(image.values[index] * image.lsb_nm * 1e-6, abs=1e-12)
                index += 1
    assert index == len(image.values)


@given(images(kinds=(2,)))
def test_second_decoder_agrees_on_grids(image):
    nodes = second.read_grid(tables.encode(image))
    nx, ny, nz = image.counts
    assert len(nodes) == nx * ny * nz
    flat = [round(c * 1e6 / image.lsb_nm) for correction in nodes.values() for c in correction]
    assert tuple(flat) == image.values
    first, second_node = list(nodes)[:2]
    assert first == pytest.approx(image.start_mm)
    assert second_node[0] == pytest.approx(image.start_mm[0] + image.step_mm[0])
    assert second_node[1:] == pytest.approx(image.start_mm[1:])


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"values": (32768, *SMALL.values[1:])}, "beyond 16 bits"),
        ({"values": (-32769, *SMALL.values[1:])}, "beyond 16 bits"),
        ({"values": SMALL.values[1:]}, "20 values instead of 21"),
        ({"kind": 3}, "kind 3"),
        ({"kind": 0}, "21 values instead of 0"),
        ({"kind": 0, "values": ()}, "no grid points"),
        ({"counts": (1, 3, 3)}, "2 or more"),
        ({"step_mm": (50.0, 0.0, 1.0)}, "pitch above 0"),
        ({"step_mm": (50.0, -1.0, 1.0)}, "pitch above 0"),
        ({"start_mm": (0.000_004, 0.0, 0.0)}, "10 nm"),
        ({"start_mm": (float("nan"), 0.0, 0.0)}, "not a number"),
        ({"start_mm": (30_000.0, 0.0, 0.0)}, "not a number within"),
        ({"table_id": 2**32}, "header"),
        ({"table_id": -1}, "header"),
        ({"lsb_nm": 0}, "unit"),
        ({"lsb_nm": 70_000}, "header"),
        ({"kind": 2, "counts": (20, 20, 20), "values": (0,) * 24_000}, "do not fit a bank"),
    ],
)
def test_refused(change, why):
    with pytest.raises(TableCodecError, match=why):
        tables.encode(replace(SMALL, **change))


@pytest.mark.parametrize("word", [0, 1, 2, 3, 7, 8, 11, 20])
def test_a_header_that_contradicts_the_protocol_is_refused(word):
    data = bytearray(tables.encode(SMALL))
    data[2 * word] ^= 0x80
    with pytest.raises(TableCodecError):
        tables.decode(bytes(data))


def test_every_truncation_and_extension_is_refused():
    data = tables.encode(SMALL)
    for size in range(len(data)):
        with pytest.raises(TableCodecError):
            tables.decode(data[:size])
        with pytest.raises(second.UnreadableImage):
            second.read_axis_tables(data[:size])
    with pytest.raises(TableCodecError):
        tables.decode(data + b"\x00\x00")
    with pytest.raises(second.UnreadableImage):
        second.read_axis_tables(data + b"\x00\x00")


@given(st.one_of(st.binary(max_size=200), st.binary(max_size=100).map(lambda tail: tables.encode(SMALL)[:24] + tail)))
def test_any_bytes_are_an_image_or_refused(data):
    try:
        image = tables.decode(data)
    except TableCodecError:
        return
    assert tables.encode(image) == data


@given(st.binary(max_size=200))
def test_the_second_decoder_is_total(data):
    for read in (second.read_axis_tables, second.read_grid):
        try:
            read(data)
        except second.UnreadableImage:
            continue


def test_any_single_bit_flip_changes_the_crc_or_is_refused():
    data = tables.encode(SMALL)
    for index in range(8 * len(data)):
        damaged = bytearray(data)
        damaged[index // 8] ^= 1 << index % 8
        assert tables.crc32(bytes(damaged)) != tables.crc32(data)


def test_wrong_kind_for_the_second_decoder():
    grid = TableImage(2, 1, 100, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (2, 2, 2), (0,) * 24)
    with pytest.raises(second.UnreadableImage, match="kind 2"):
        second.read_axis_tables(tables.encode(grid))
    with pytest.raises(second.UnreadableImage, match="kind 1"):
        second.read_grid(tables.encode(SMALL))
