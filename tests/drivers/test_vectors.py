"""Byte strings typed from docs/protocols, against the driver's codecs."""

from __future__ import annotations

import pytest

from abbe.drivers.api import BankState, BarSample, Condition, LaserFlag
from abbe.drivers.ballbar import frames
from abbe.drivers.ballbar.frames import Ack, FrameDecoder, Info
from abbe.drivers.cnc import registers as cnc
from abbe.drivers.laser import driver as laser
from abbe.drivers.links.modbus import tcp_mismatch
from abbe.drivers.links.words import words_of

IDENTIFY = "A5 5A 81 02 01 00 1D 72"
START = "A5 5A 82 04 02 00 E8 03 66 9C"
STOP = "A5 5A 83 02 03 00 17 F9"
ACK = "A5 5A 03 04 02 00 82 00 64 D9"
SAMPLE = "A5 5A 01 12 07 00 00 00 87 D6 12 00 00 00 00 00 C7 CF FF FF 08 00 A8 E2"
INFO = "A5 5A 02 1C 01 00 01 00 FE CA 67 12 00 00 00 01 E8 03 00 00 41 42 42 2D 31 00 00 00 00 00 00 00 EA F7"
CANARY_REQUEST = "00 01 00 00 00 06 01 03 00 00 00 04"
CANARY_ANSWER = "00 01 00 00 00 0B 01 03 08 01 02 03 04 44 9A 50 00"


def test_crc_check_value():
    assert frames.crc16(b"123456789") == 0x29B1


@pytest.mark.parametrize(
    ("built", "typed"),
    [(frames.identify_command(1), IDENTIFY), (frames.start_command(2, 1000), START), (frames.stop_command(3), STOP)],
)
def test_ballbar_commands(built, typed):
    assert built == bytes.fromhex(typed)


@pytest.mark.parametrize(
    ("typed", "frame"),
    [
        (ACK, Ack(tag=2, command=0x82, result=0)),
        (SAMPLE, BarSample(seq=7, device_us=1234567, reading_nm=-12345, status=8)),
        (INFO, Info(tag=1, boot_id=0xCAFE0001, serial_no=4711, firmware=0x0100, max_rate_hz=1000, rate_hz=0, model="ABB-1")),
    ],
)
def test_ballbar_answers(typed, frame):
    assert FrameDecoder().feed(bytes.fromhex(typed)) == [frame]


@pytest.mark.parametrize("block", [laser.IDENTITY, cnc.IDENTITY])
def test_canaries(block):
    answer = bytes.fromhex(CANARY_ANSWER)
    assert tcp_mismatch(bytes.fromhex(CANARY_REQUEST), answer) == ""
    words = words_of(answer[9:])
    counts = block.counts(words + (0,) * (block.count - 4))
    assert counts["CANARY_I32"] == 0x01020304
    assert counts["CANARY_F32"] == 0x449A5000


def test_motion_command_layout():
    words = cnc.encode_motion(7, cnc.MOVE, (100_000, -1, 0), 1500.0)
    assert words == (7, 1, 0x0001, 0x86A0, 0xFFFF, 0xFFFF, 0, 0, 0x0002, 0x49F0)
    assert len(words) == 10


def test_fifo_layout():
    assert cnc.encode_fifo(3, [(1, -2, 0x10000)]) == (3, 1, 0, 1, 0xFFFF, 0xFFFE, 1, 0)
    assert cnc.FIFO_ADDRESS + len(cnc.encode_fifo(1, [(0, 0, 0)] * 19)) == 212


def test_comp_command_layout():
    words = cnc.encode_comp(9, cnc.ACTIVATE, bank=1, expect_crc=0x12345678, expect_gen=5, owner=0xABCD0001, lease_ms=60000)
    assert words == (9, 2, 1, 0x1234, 0x5678, 0, 5, 0xABCD, 1, 0, 60000)


def test_status_layout():
    words = [0] * 48

    def put(address: int, *values: int) -> None:
        words[address - 16 : address - 16 + len(values)] = values

    put(16, 0, 1, 2, 3)
    put(20, 0, 0b1_0000_0000_0100)
    put(22, 2)
    put(23, 11, 3, 10)
    put(26, 0xFFFF, 0xFFFF, 0, 1, 1, 0)
    put(32, 8000)
    put(33, 1, 2)
    put(35, 0, 0, 0, 5)
    put(39, 0, 0, 0, 6)
    put(43, 100)
    put(44, 0, 0, 1, 0)
    put(48, 4, 1)
    block = cnc.decode_status(words, 1.5)
    status = block.status
    assert status.host_s == 1.5
    assert status.ctrl_us == (1 << 32) + (2 << 16) + 3
    assert status.conditions == Condition.SPINDLE | Condition.ALARM
    assert (block.alarm_code, block.motion_ack_seq, block.motion_result, block.motion_done_seq) == (2, 11, 3, 10)
    assert status.position_mm == (-0.00001, 0.00001, 0.65536)
    assert (block.fifo_free, status.path_points_done, status.path_start_us, status.path_end_us) == (8000, 65538, 5, 6)
    assert (status.override_percent, status.in_position_us, block.fifo_ack_seq, block.fifo_result) == (100, 65536, 4, 1)


def test_comp_status_layout():
    words = (1, 0x1111, 0x2222, 0x3333, 0x4444, 2, 1, 6, 0, 0, 77, 0, 5000, 0, 0, 0)
    status = cnc.decode_comp_status(words, boot_id=8, gen=9)
    assert (status.active_bank, status.bank_crc, status.bank_state) == (1, (0x11112222, 0x33334444), (BankState.SEALED, BankState.WRITING))
    assert (status.lease_owner, status.lease_left_ms, status.boot_id, status.gen) == (77, 5000, 8, 9)


def test_laser_reading_layout():
    words = (0, 9, 0, 0, 0, 50_000, 0xFFFF, 0xFFFF, 0xFFFF, 0xFFFE, 950, 0b1100, 0xFFFB, 1, 0x8BCD, 455, 0x0029, 0x32E0)
    reading = laser.decode_reading(words, 2.0)
    assert (reading.sample_count, reading.device_us, reading.displacement_tenth_nm) == (9, 50_000, -2)
    assert (reading.signal_permille, reading.status) == (950, LaserFlag.ZEROED | LaserFlag.COMPENSATED)
    assert (reading.air_temp_c, reading.air_pressure_pa, reading.humidity_percent) == (-0.05, 101325.0, 45.5)
    assert reading.refractivity == 0x002932E0 / 1e10
