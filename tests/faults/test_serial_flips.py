"""S4: bits turned over. Every single one is detected; what CRC-16 cannot see meets the second gate."""

from __future__ import annotations

import itertools
import random
from binascii import crc_hqx
from collections import defaultdict

import pytest

from abbe.drivers.ballbar.frames import FrameDecoder
from abbe.simulators.faults.serial_bytes import flipped
from tests.faults.contract import Observed, assert_fault_contract
from tests.faults.modbus_bytes import request, taken
from tests.faults.rows_serial import INVISIBLE, INVISIBLE_BLIND, MBAP_CHECKED
from tests.faults.serial_pure import NO_ACCOUNT, hear, honest
from tests.faults.test_serial_bytes import BOX, FRAMES, REGISTERS, bytes_only, good

DRAWN = 4000
FIRST_CHECKED, CHECKED = 2, 22
"""The check sum of a SAMPLE covers itself and 20 bytes before it, from byte 2 on."""
SLEW_NM, JITTER_US = 100_000, 50


@pytest.mark.parametrize("name", BOX)
def test_every_single_bit_of_a_box_frame(name):
    frame, behind = FRAMES[name], b"".join(sample.frame() for sample in honest(3))
    for bit in range(8 * len(frame)):
        decoder = FrameDecoder()
        found = good(decoder.feed(flipped(frame, bit) + behind)) + good(decoder.feed(bytes(40)))
        true = good(FrameDecoder().feed(behind))
        assert found[-3:] == true, "resynchronised at the next frame"
        bytes_only("S4", f"{name} {bit}", resumed=True, wrong=len(found) - 3)


@pytest.mark.parametrize("rtu", [False, True], ids=["mbap", "rtu"])
def test_every_single_bit_of_a_reply(rtu):
    name, asked = "rtu" if rtu else "mbap", request(rtu=rtu)
    for bit in range(8 * (len(FRAMES[name]) if rtu else MBAP_CHECKED)):
        heard = taken(asked, flipped(FRAMES[name], bit), rtu=rtu)
        again = taken(asked, FRAMES[name], rtu=rtu)
        bytes_only("S4", f"{name} {bit}", resumed=again == REGISTERS, wrong=heard is not None)


@pytest.mark.parametrize("name", [*BOX, "rtu"])
def test_two_to_five_bits_drawn(name):
    draw, frame, false = random.Random(f"S4 {name}"), FRAMES[name], 0
    asked = request(rtu=True)
    for _ in range(DRAWN):
        spoilt = flipped(frame, *draw.sample(range(8 * len(frame)), draw.randint(2, 5)))
        if name == "rtu":
            false += taken(asked, spoilt, rtu=True) is not None
        else:
            false += bool(good(FrameDecoder().feed(spoilt + bytes(40))))
    bytes_only("S4", f"{name} drawn", resumed=true_again(name), wrong=false)


def true_again(name: str) -> bool:
    return name == "rtu" or len(good(FrameDecoder().feed(FRAMES[name]))) == 1


def invisible() -> list[tuple[int, ...]]:
    """All sets of four bits of a SAMPLE whose change the check sum does not show: pairs of pairs with the same effect on it."""
    effect = []
    for bit in range(8 * CHECKED):
        changed = flipped(bytes(CHECKED), bit)
        effect.append(crc_hqx(changed[:-2], 0) ^ int.from_bytes(changed[-2:], "little"))
    pairs = defaultdict(list)
    for a, b in itertools.combinations(range(8 * CHECKED), 2):
        pairs[effect[a] ^ effect[b]].append((a, b))
    found = {tuple(sorted({*x, *y})) for same in pairs.values() for x, y in itertools.combinations(same, 2) if len({*x, *y}) == 4}
    return [tuple(bit + 8 * FIRST_CHECKED for bit in bits) for bits in sorted(found)]


async def test_what_the_check_sum_cannot_see_meets_the_second_gate():
    sent = honest(60)
    frames = [sample.frame() for sample in sent]
    patterns, blind = invisible(), []
    assert len(patterns) == INVISIBLE
    for bits in patterns:
        spoilt = flipped(frames[30], *bits)
        heard = await hear([b"".join([*frames[:30], spoilt, *frames[31:], bytes(40)])])
        samples = {sample.seq: sample for sample in heard.tap.samples}
        truth = {sample.seq: sample for sample in sent}
        if all(vars_of(sample) == vars_of(truth[seq]) for seq, sample in samples.items()):
            continue
        blind.append(bits)
        (wrong,) = (seq for seq, sample in samples.items() if vars_of(sample) != vars_of(truth[seq]))
        assert wrong == 30
        assert abs(samples[30].device_us - truth[30].device_us) <= JITTER_US, "only jitter, readings and flags can slip through"
        assert abs(samples[30].reading_nm - truth[30].reading_nm) <= 2 * SLEW_NM or samples[30].status & 0b10001
    # What is left has its wrong bits in the lower half of the reading, the microseconds or the flags: it looks like a measurement.
    assert len(blind) == INVISIBLE_BLIND
    facts = {"absorbed": True, "state": "listening", "resumed": True, "left_out": {"A": NO_ACCOUNT}}
    assert_fault_contract(Observed("S4", "sample four-bit-patterns", **facts))


def vars_of(sample):
    return sample.seq, sample.device_us, sample.reading_nm, sample.status
