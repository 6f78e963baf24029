"""Register map of the laser displacement meter (docs/protocols/laser.md) as data, and the pure decoder of a reading."""

from __future__ import annotations

from collections.abc import Sequence

from abbe.drivers.api import LaserReading
from abbe.drivers.links.words import Register, RegisterBlock

MAP_VERSION = 1

IDENTITY = RegisterBlock(
    0,
    9,
    (
        Register(0, "i32", "CANARY_I32"),
        Register(2, "u32", "CANARY_F32"),
        Register(4, "u16", "MAP_VER"),
        Register(5, "u32", "BOOT_ID"),
        Register(7, "u32", "SERIAL_NO"),
    ),
)

READING = RegisterBlock(
    10,
    18,
    (
        Register(10, "u32", "SAMPLE_COUNT"),
        Register(12, "u64", "DEVICE_TIME_US", 1e6, "s"),
        Register(16, "i64", "DISPLACEMENT", 1e7, "mm"),
        Register(20, "u16", "SIGNAL", 1000.0),
        Register(21, "u16", "STATUS"),
        Register(22, "i16", "AIR_TEMPERATURE", 100.0, "degree C"),
        Register(23, "u32", "AIR_PRESSURE", 1.0, "Pa"),
        Register(25, "u16", "HUMIDITY", 10.0, "%"),
        Register(26, "u32", "REFRACTIVITY", 1e10),
    ),
    lead=10,
)

ACKNOWLEDGE = RegisterBlock(43, 2, (Register(43, "u16", "CMD_ACK_SEQ"), Register(44, "u16", "CMD_RESULT")), lead=3)

COMMAND_ADDRESS = 40
ZERO, CLEAR_BEAM, ENVIRONMENT = 1, 2, 3
RESULT_TEXT = {1: "bad argument", 2: "refused: beam blocked"}


def decode_reading(words: Sequence[int], host_s: float) -> LaserReading:
    """Turn registers 10..27 of one request into a reading.

    Parameters
    ----------
    words : sequence of int
        The 18 registers.
    host_s : float
        Monotonic host seconds at the last byte.
    """
    counts = READING.counts(words)
    return LaserReading(
        host_s=host_s,
        sample_count=counts["SAMPLE_COUNT"],
        device_us=counts["DEVICE_TIME_US"],
        displacement_tenth_nm=counts["DISPLACEMENT"],
        signal_permille=counts["SIGNAL"],
        status=counts["STATUS"],
        air_temp_c=READING.physical("AIR_TEMPERATURE", counts["AIR_TEMPERATURE"]),
        air_pressure_pa=READING.physical("AIR_PRESSURE", counts["AIR_PRESSURE"]),
        humidity_percent=READING.physical("HUMIDITY", counts["HUMIDITY"]),
        refractivity=READING.physical("REFRACTIVITY", counts["REFRACTIVITY"]),
    )
