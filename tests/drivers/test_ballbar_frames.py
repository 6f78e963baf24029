"""The ball-bar decoder: total, resynchronising, and blind to no single-bit error."""

from __future__ import annotations

import itertools
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from abbe.drivers.api import BarSample
from abbe.drivers.ballbar import frames
from abbe.drivers.ballbar.frames import Ack, Bad, FrameDecoder, Info

SAMPLE = bytes.fromhex("A55A01120700000087D6120000000000C7CFFFFF0800A8E2")
INFO = bytes.fromhex("A55A021C01000100FECA671200000001E80300004142422D3100000000000000EAF7")
ACK = bytes.fromhex("A55A030402008200 64D9")

samples = st.builds(
    BarSample,
    seq=st.integers(0, 2**32 - 1),
    device_us=st.integers(0, 2**64 - 1),
    reading_nm=st.integers(-(2**31), 2**31 - 1),
    status=st.integers(0, 0xFFFF),
)


def wire(sample: BarSample) -> bytes:
    return frames.encode(frames.SAMPLE, struct.pack("<IQiH", sample.seq, sample.device_us, sample.reading_nm, sample.status))


def split(data: bytes, cuts: list[int]) -> list[bytes]:
    edges = [0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]
    return [data[a:b] for a, b in itertools.pairwise(edges)]


def good(out):
    return [frame for frame in out if not isinstance(frame, Bad)]


@given(st.lists(samples), st.lists(st.integers(0, 10_000)))
def test_round_trip_in_any_pieces(sent, cuts):
    decoder = FrameDecoder()
    out = [frame for piece in split(b"".join(map(wire, sent)), cuts) for frame in decoder.feed(piece)]
    assert out == sent
    assert decoder.pending == 0


@given(
    st.lists(st.one_of(st.binary(max_size=60), st.just(SAMPLE), st.just(b"\xa5\x5a"), st.just(b"\xa5\x5a\x01\x12"))),
    st.lists(st.integers(0, 999)),
)
def test_any_bytes_give_frames_or_counted_bad_bytes(parts, cuts):
    data = b"".join(parts)
    decoder = FrameDecoder()
    out = [frame for piece in split(data, cuts) for frame in decoder.feed(piece)]
    size = {BarSample: 24, Info: 34, Ack: 10}
    assert sum(frame.n_bytes if isinstance(frame, Bad) else size[type(frame)] for frame in out) + decoder.pending == len(data)
    assert decoder.pending < 38
    whole = FrameDecoder()
    assert good(whole.feed(data)) == good(out)


@given(st.binary(max_size=300))
def test_no_good_frame_is_lost_after_garbage(noise):
    decoder = FrameDecoder()
    out = decoder.feed(noise) + decoder.feed(SAMPLE * 3)
    found = [frame for frame in out if frame == BarSample(7, 1234567, -12345, 8)]
    # noise that ends in a false header may hold back what follows until that false frame is complete, never longer
    assert len(found) >= 1
    out += decoder.feed(bytes(40))
    assert len([frame for frame in out if frame == BarSample(7, 1234567, -12345, 8)]) >= 3


@pytest.mark.parametrize("frame", [SAMPLE, INFO, ACK], ids=["sample", "info", "ack"])
def test_every_single_bit_flip_is_detected(frame):
    for index in range(len(frame)):
        for bit in range(8):
            damaged = bytearray(frame)
            damaged[index] ^= 1 << bit
            decoder = FrameDecoder()
            out = decoder.feed(bytes(damaged)) + decoder.feed(bytes(64))
            assert good(out) == []


@pytest.mark.parametrize("frame", [SAMPLE, INFO, ACK], ids=["sample", "info", "ack"])
def test_truncation_at_every_byte_gives_nothing_and_costs_no_later_frame(frame):
    for size in range(len(frame)):
        decoder = FrameDecoder()
        assert good(decoder.feed(frame[:size])) == []
        assert len(good(decoder.feed(SAMPLE * 2))) >= 1


@pytest.mark.parametrize(
    "noise", [b"\xff", b"\x00" * 7, b"\xa5\x5a" * 32, b"\xa5" * 64, b"\xa5\x5a\x01\xff", b"\xa5\x5a\x7f\x20", b"\x5a\xa5" * 2048]
)
def test_known_nasty_noise(noise):
    decoder = FrameDecoder()
    assert len(good(decoder.feed(noise + SAMPLE * 3))) == 3


def test_a_burst_that_damages_every_nth_frame_costs_only_those():
    for n in range(2, 60):
        pieces = [SAMPLE if i % n else SAMPLE[:9] + b"\x99\x99" + SAMPLE[11:] for i in range(200)]
        out = FrameDecoder().feed(b"".join(pieces))
        assert len(good(out)) == sum(1 for i in range(200) if i % n)
        assert any(frame.reason == "check sum" for frame in out if isinstance(frame, Bad))


def test_unknown_types_are_skipped_whole():
    out = FrameDecoder().feed(frames.encode(0x42, b"future") + SAMPLE)
    assert out == [Bad("unknown type", 12), BarSample(7, 1234567, -12345, 8)]


def test_payload_limit():
    with pytest.raises(ValueError, match="32"):
        frames.encode(1, bytes(33))
