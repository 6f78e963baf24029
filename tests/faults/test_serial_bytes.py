"""S2, S3, S9: garbage, frames that are cut off, and bytes in other pieces."""

from __future__ import annotations

import random

import pytest

from abbe.drivers.ballbar.frames import Bad, FrameDecoder
from abbe.simulators.ballbar.device import Settings
from abbe.simulators.ballbar.wire import encode_ack, encode_info, encode_settings
from abbe.simulators.faults.serial_bytes import garbage, sliced
from tests.faults.contract import Observed, assert_fault_contract
from tests.faults.modbus_bytes import COUNT, reply, request, taken
from tests.faults.rows_serial import S2_KINDS, S2_SIZES, S2_WHERE, S9_READS, TYPES
from tests.faults.serial_pure import NO_ACCOUNT, honest, judged

REGISTERS = tuple(0x1111 * i for i in range(1, COUNT + 1))
FRAMES = {
    "sample": honest(4)[3].frame(),
    "info": encode_info(7, 0xCAFE0001, 0),
    "ack": encode_ack(7, 0x82, 0),
    "settings": encode_settings(7, Settings()),
    "mbap": reply(REGISTERS, rtu=False),
    "rtu": reply(REGISTERS, rtu=True),
}
BOX = tuple(name for name in FRAMES if name not in ("mbap", "rtu"))


def good(frames):
    return [frame for frame in frames if not isinstance(frame, Bad)]


def bytes_only(row: str, case: str, *, resumed: bool, wrong: int = 0) -> None:
    facts = {"absorbed": True, "state": "listening", "resumed": resumed, "wrong_values": wrong, "left_out": {"A": NO_ACCOUNT}}
    assert_fault_contract(Observed(row, case, **facts))


def test_the_frames_are_as_long_as_the_rows_say():
    assert {name: len(frame) for name, frame in FRAMES.items()} == TYPES


@pytest.mark.parametrize("kind", S2_KINDS)
async def test_garbage(kind):
    sent = honest(3000)
    frames = [sample.frame() for sample in sent]
    for where in S2_WHERE:
        for size in S2_SIZES:
            noise = garbage(kind, size, random.Random(f"{kind} {where} {size}"))
            hit = frames[1500]
            spoilt = {"before": noise + hit, "after": hit + noise, "inside": hit[:11] + noise + hit[11:]}[where]
            pieces = [b"".join(frames[:1500]) + spoilt, b"".join(frames[1501:])]
            heard = await judged("S2", f"{where} {size} {kind}", pieces, sent)
            assert len(heard.tap.samples) == 3000 - (where == "inside"), "a good frame was lost: the first one after garbage counts"
            assert heard.bad_bytes == size + (24 if where == "inside" else 0)
            assert heard.pending == 0


@pytest.mark.parametrize("name", BOX)
def test_a_box_frame_cut_off_at_every_byte(name):
    whole, following = FRAMES[name], [sample.frame() for sample in honest(3)]
    for size in range(len(whole)):
        decoder = FrameDecoder()
        nothing = good(decoder.feed(whole[:size])) == []
        behind = good(decoder.feed(b"".join(following)))
        assert len(behind) >= 1, "resynchronised within two frames"
        assert len(behind) + len(good(decoder.feed(bytes(40)))) == 3
        bytes_only("S3", f"{name} {size}", resumed=nothing, wrong=not nothing)


@pytest.mark.parametrize("rtu", [False, True], ids=["mbap", "rtu"])
def test_a_reply_cut_off_at_every_byte(rtu):
    name, asked = "rtu" if rtu else "mbap", request(rtu=rtu)
    for size in range(len(FRAMES[name])):
        refused = taken(asked, FRAMES[name][:size], rtu=rtu) is None
        bytes_only("S3", f"{name} {size}", resumed=taken(asked, FRAMES[name], rtu=rtu) == REGISTERS, wrong=not refused)


@pytest.mark.parametrize("name", BOX)
def test_other_pieces_of_a_stream_of_frames(name):
    data = FRAMES[name] * 2731  # 64 KiB of samples
    whole = FrameDecoder().feed(data)
    for reads, size in zip(S9_READS, (1, 65536), strict=True):
        decoder = FrameDecoder()
        pieces = [frame for piece in sliced(data, size) for frame in decoder.feed(piece)]
        assert len(pieces) == 2731
        bytes_only("S9", f"{reads} {name}", resumed=pieces == whole and decoder.pending == 0)


@pytest.mark.parametrize("rtu", [False, True], ids=["mbap", "rtu"])
def test_other_pieces_of_a_reply(rtu):
    name, asked = "rtu" if rtu else "mbap", request(rtu=rtu)
    heard, results = b"", []
    for byte in sliced(FRAMES[name], 1):
        heard += byte
        results.append(taken(asked, heard, rtu=rtu))
    bytes_only("S9", f"one-byte {name}", resumed=results[-1] == REGISTERS, wrong=sum(r is not None for r in results[:-1]))
    block = taken(asked, FRAMES[name], rtu=rtu)
    twice = taken(asked, FRAMES[name] * 2, rtu=rtu)  # two replies to one request: neither is believed
    bytes_only("S9", f"64-KiB {name}", resumed=block == REGISTERS, wrong=twice is not None)
