"""The rows of the serial line and its stream of samples, S1 to S12."""

from __future__ import annotations

from tests.faults.catalogue import Row, crossed

TYPES = {"sample": 24, "info": 34, "ack": 10, "settings": 18, "mbap": 27, "rtu": 23}
"""Whole frames by type, in bytes: four of the ball-bar's box, and a reply of nine registers on Modbus TCP and RTU."""
MBAP_CHECKED = 9
"""Bytes of the MBAP reply whose value the request fixes; the registers behind them are guarded by TCP's own check sum."""

S1_MOMENTS, S1_REPLUG = ("open", "idle", "arming", "mid-frame", "stopping", "closing"), ("same-node", "new-node", "other-serial", "never")
S2_WHERE, S2_SIZES, S2_KINDS = ("before", "inside", "after"), (1, 7, 64, 4096), ("random", "ones", "sync", "header")
S3 = tuple(f"{name} {size}" for name, whole in TYPES.items() for size in range(whole))
S4 = tuple(f"{name} {bit}" for name, whole in TYPES.items() for bit in range(8 * (MBAP_CHECKED if name == "mbap" else whole)))
S4_DRAWN = tuple(f"{name} drawn" for name in ("sample", "info", "ack", "settings", "rtu"))
INVISIBLE, INVISIBLE_BLIND = 1592, 10
"""Patterns of four bits in a SAMPLE that CRC-16 cannot see, and those of them that no other gate sees either (counted by the test)."""
S4_BLIND = ("sample four-bit-patterns",)
S5_WHAT, S5_COUNTS = ("duplicate", "late", "swapped"), (1, 2, 10, 100)
S6_MOMENTS, S6_AFTER = ("start", "mid", "reversal", "end"), ("config-same", "range-changed", "zero-changed")
S7 = ("host +1h", "host -1h", "host +1y", "host -1y", "device +100ppm", "device -100ppm", "device +1000ppm", "device -1000ppm")
S8_LENGTHS, S8_MOMENTS = ("1ms", "100ms", "5s", "for-ever"), ("start", "mid", "reversal", "last")
S8_LASER = ("laser beam-lost", "laser signal-low", "laser never-zeroed", "laser no-reflector")
S9_READS = ("one-byte", "64-KiB")
S10 = ("rate x0.5", "rate x2", "rate x10", "stall 50ms", "stall 500ms", "stall 5000ms")
S11 = (
    "tx held", "tx full", "second opener", "baud 115200", "baud 921600", "parity even", "parity odd",
    "unit between-runs", "unit mid-run", "range between-runs", "range mid-run",
)  # fmt: skip
S12 = tuple(f"every {n}" for n in range(2, 202))
S12_RARE = ("every 1001", "every 2001", "every 5001")

ROWS = (
    Row(
        "S1",
        "cable pulled, and plugged in again at the same place, at another one, with another box, or never",
        "the box is known by adapter and serial number, never by the number of the port; another one is refused",
        crossed(S1_MOMENTS, S1_REPLUG),
        "test_serial_cable.py",
    ),
    Row(
        "S2",
        "garbage before, inside and after a frame",
        "no good frame behind it is lost; what is kept waiting is less than one frame; bytes are counted",
        crossed(S2_WHERE, map(str, S2_SIZES), S2_KINDS),
        "test_serial_bytes.py",
    ),
    Row("S3", "frame cut off at every byte", "nothing is delivered of it, and the next frames are", S3, "test_serial_bytes.py"),
    Row(
        "S4",
        "every single bit turned over; 4,000 times 2 to 5 bits per type; every pattern of four bits that CRC-16 cannot see",
        "every single bit is detected; what the check sum lets through meets the second gate (number, clock, stroke, slew, settings)",
        S4 + S4_DRAWN + S4_BLIND,
        "test_serial_flips.py",
        (
            ("mbap: bits of the register values", "Modbus TCP has no check sum of its own: TCP's guards them"),
            (
                f"{INVISIBLE_BLIND} of the {INVISIBLE} patterns of four bits that CRC-16 cannot see",
                "they change the lower bits of the reading (by less than 0.2 mm), the microseconds (by less than 50) or a flag, and look "
                "like a measurement; all patterns of one, two, three and five bits are detected",
            ),
        ),
    ),
    Row(
        "S5",
        "frames twice, late, or in another order",
        "each number once; what is late is part of a gap; older than 128 samples ends the stream",
        (*crossed(S5_WHAT, map(str, S5_COUNTS)), "late 500"),
        "test_serial_order.py",
    ),
    Row(
        "S6",
        "box restarts in the middle of a run, and comes back with its settings, another range, or another zero",
        "the segment ends; nothing is spliced; identify, and set the settings again, before anything else",
        crossed(S6_MOMENTS, S6_AFTER),
        "test_serial_box.py",
    ),
    Row(
        "S7",
        "host clock jumps; device clock fast or slow",
        "samples keep their order and the device's time; the host's time of arrival is monotonic",
        S7,
        "test_serial_box.py",
        (
            ("host clock slewed by 500 ppm", "a monotonic clock is slewed for everybody alike; the alignment of clocks fits it as drift"),
            ("offset recorded at both ends", "belongs to the alignment of clocks, not to the link"),
        ),
    ),
    Row(
        "S8",
        "bar out of range or gone; laser beam lost, signal low, not zeroed",
        "samples come flagged and in their places, none is made up; a laser that lost counts says so until it is zeroed",
        crossed(S8_LENGTHS, S8_MOMENTS) + S8_LASER,
        "test_serial_box.py",
        (("test point repeated from a checkpoint", "the sequencer's business, tested there; the links only flag and refuse"),),
    ),
    Row(
        "S9",
        "bytes one by one, or all at once",
        "the same frames",
        crossed(S9_READS, TYPES),
        "test_serial_bytes.py",
    ),
    Row("S10", "other rate than asked for; pauses", "the watchdog looks at samples, not at bytes", S10, "test_serial_line.py"),
    Row(
        "S11",
        "line takes no bytes; second opener; wrong baud rate or parity; unit or range switched at the box",
        "deadlines; one opener only; what is heard but not understood is said; settings are numbered in every sample",
        S11,
        "test_serial_line.py",
    ),
    Row(
        "S12",
        "electric bursts hit every n-th frame",
        "more than 0.1 % lost ends the run, up to that every gap is recorded",
        S12 + S12_RARE,
        "test_serial_order.py",
    ),
)
