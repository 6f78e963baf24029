"""Whatever one side writes the other reads: the box's frames, the host's commands, registers and words."""

from __future__ import annotations

import struct

from hypothesis import given
from hypothesis import strategies as st

from abbe.drivers.ballbar import frames
from abbe.drivers.ballbar.frames import Ack, BoxSettings, FrameDecoder, Info
from abbe.drivers.laser import driver as laser
from abbe.drivers.links.words import bytes_of, words_of
from abbe.simulators.ballbar.device import Settings as DeviceSettings
from abbe.simulators.ballbar.wire import Parser, encode_ack, encode_info, encode_settings

u8, u16, u32, i32 = st.integers(0, 255), st.integers(0, 0xFFFF), st.integers(0, 2**32 - 1), st.integers(-(2**31), 2**31 - 1)
SETTINGS = bytes.fromhex("A55A040C0500010040420F000000000000B5")
READ_SETTINGS = bytes.fromhex("A55A840205009C02")
CONFIGURE = bytes.fromhex("A55A850C0600000040420F003CF6FFFFE3DC")


def test_examples_of_the_protocol():
    assert FrameDecoder().feed(SETTINGS) == [BoxSettings(5, 1, frames.NANOMETRE, 1_000_000, 0)]
    assert encode_settings(5, DeviceSettings()) == SETTINGS
    assert frames.read_settings_command(5) == READ_SETTINGS
    assert frames.configure_command(6, frames.NANOMETRE, 1_000_000, -2500) == CONFIGURE


@given(u16, u32, u16, u32, u16)
def test_info(tag, boot_id, rate_hz, serial_no, firmware):
    (info,) = FrameDecoder().feed(encode_info(tag, boot_id, rate_hz, serial_no, firmware))
    assert info == Info(tag, boot_id, serial_no, firmware, 1000, rate_hz, "ABB-1")


@given(u16, u8, u8)
def test_ack(tag, command, result):
    assert FrameDecoder().feed(encode_ack(tag, command, result)) == [Ack(tag, command, result)]


@given(u16, st.integers(1, 255), st.booleans(), st.integers(1, 10_000_000), st.integers(-10_000_000, 10_000_000))
def test_settings(tag, number, inch, range_nm, zero_nm):
    frame = encode_settings(tag, DeviceSettings(number, inch, range_nm * 1e-6, zero_nm * 1e-6))
    assert FrameDecoder().feed(frame) == [BoxSettings(tag, number, int(inch), range_nm, zero_nm)]


@given(u16, u16, u8, u32, i32)
def test_commands(tag, rate_hz, unit, range_nm, zero_nm):
    line = frames.identify_command(tag) + frames.start_command(tag, rate_hz) + frames.stop_command(tag)
    line += frames.read_settings_command(tag) + frames.configure_command(tag, unit, range_nm, zero_nm)
    assert [(kind, struct.unpack_from("<H", payload)[0]) for kind, payload in Parser().feed(line)] == [
        (kind, tag) for kind in (frames.IDENTIFY, frames.START, frames.STOP, frames.READ_SETTINGS, frames.CONFIGURE)
    ]


@given(st.lists(u16))
def test_words(words):
    assert list(words_of(bytes_of(words))) == words


i64, i16 = st.integers(-(2**63), 2**63 - 1), st.integers(-(2**15), 2**15 - 1)


@given(st.tuples(u32, st.integers(0, 2**64 - 1), i64, u16, u16, i16, u32, u16, u32))
def test_a_laser_reading(values):
    reading = laser.decode_reading(words_of(struct.pack(">IQqHHhIHI", *values)), 1.5)
    counts = (reading.sample_count, reading.device_us, reading.displacement_tenth_nm, reading.signal_permille, reading.status)
    assert counts == values[:5]
    assert (round(reading.air_temp_c * 100), reading.air_pressure_pa, round(reading.humidity_percent * 10)) == values[5:8]
    assert round(reading.refractivity * 1e10) == values[8]
