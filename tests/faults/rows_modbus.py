"""Rows M1 to M11 of the fault matrix: the Modbus link to controller and laser."""

from __future__ import annotations

from tests.faults.catalogue import Row, crossed

READS = ("identity", "status", "compensation status", "bank read", "laser reading", "laser acknowledge")
WRITES = ("motion command", "hold", "path points", "compensation command", "bank write", "laser command")
KINDS = READS + WRITES
CODES = ("01", "02", "03", "04", "05", "06", "08", "0A", "0B")
FACTORS = ("1.05", "2", "10")
PAIRS = ("read-read", "read-write", "write-read", "activate-read")
WRONG_READ = ("unit", "tid", "function", "another's exception", "byte count", "fewer registers", "more registers")
WRONG_WRITE = ("unit", "tid", "function", "another's exception", "echo address", "echo count", "echo too long")
SEGMENTS = (
    "one byte at a time",
    "two halves",
    "two replies in one segment",
    "length too large",
    "length too small",
    "length 0",
    "length 65535",
    "protocol id 1",
)
ORDERS = ("CDAB", "BADC", "DCBA")
MAP_FIELDS = ("MAP_VER", "N_AXES", "TABLE_LSB_NM", "BANK_SIZE", "FIFO_SIZE")
LINE_FAULTS = ("echo", "collision", "foreign master", "noise tail", "noise in front", "gap inside a reply")
LINE_KINDS = ("status", "motion command", "laser reading", "laser command")

_TEST = "test_modbus_matrix.py"
_LATER = "tests/push plays faults at every operation of a push; its single requests (bank write, compensation command) are played here"
_RTU_WRONG = {"tid": "check sum"}


def _mismatches(line: str, names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(_RTU_WRONG.get(name, name) if line == "rtu" else name for name in names)


ROWS = (
    Row(
        "M1",
        "exception codes",
        "by table (drivers/links/modbus_link.py): 05, 06 bounded wait, 05 never taken for done, 01 to 03 name the map",
        crossed(CODES, KINDS),
        _TEST,
    ),
    Row(
        "M2",
        "late reply after a timeout or a cancellation",
        "0 wrong values; RTU: silence for one timeout, then the canary, before anything is believed",
        crossed(("tcp", "rtu"), ("timeout", "cancel"), PAIRS, FACTORS),
        _TEST,
    ),
    Row(
        "M3",
        "half-open connection (black hole)",
        "noticed within 3 s",
        ("idle", "while the axes move", *KINDS),
        _TEST,
        (("the 14 states of a push", _LATER),),
    ),
    Row(
        "M4",
        "RST and FIN",
        "numbered commands are decided by their acknowledge, nothing is sent twice",
        crossed(("rst", "fin"), ("before", "after"), KINDS),
        _TEST,
        (("at each of the 44 operations of a push", _LATER),),
    ),
    Row(
        "M5",
        "latency of 0.01, 0.1, 1.05 and 5 timeouts, always or for one request of 100",
        "slow is not wrong: right values or a timeout that says so",
        crossed(("0.01", "0.1", "1.05", "5"), ("always", "one of 100"), ("status", "laser reading", "motion command")),
        _TEST,
        (("latency during a push", _LATER),),
    ),
    Row(
        "M6",
        "segments, MBAP length, protocol id",
        "a whole reply is read however it is cut; anything else closes the socket",
        SEGMENTS,
        _TEST,
    ),
    Row(
        "M7",
        "replies that do not answer the request",
        "refused as DRV-004 (wrong register count, echo and function are what the library lets pass)",
        tuple(
            f"{line} {kind} {name}"
            for line in ("tcp", "rtu")
            for kinds, names in ((READS, WRONG_READ), (WRITES, WRONG_WRITE))
            for kind in kinds
            for name in _mismatches(line, names)
        ),
        _TEST,
        (("echo of a single value (FC6)", "we write with FC16 only, whose echo is address and count"),),
    ),
    Row(
        "M8",
        "byte and word order",
        "the canaries tell which order it is; the device is refused at connect",
        (
            *crossed(("controller", "laser"), ORDERS, ("int32", "float32")),
            *crossed(("controller", "laser"), ("CDAB", "DCBA"), ("int64",)),
            "controller ABCD",
            "laser ABCD",
        ),
        _TEST,
        (
            ("float64", "no register of the maps is a float64"),
            (
                "BADC of 64-bit values alone",
                "bytes are swapped per register, so the canaries show it; a time with swapped bytes is as likely as any",
            ),
            ("canaries before each push", _LATER),
        ),
    ),
    Row(
        "M9",
        "another register map",
        "refused at connect if the driver does not know it, and after a reconnection in any case, with both maps in words",
        crossed(("at connect", "after a reconnection"), MAP_FIELDS),
        _TEST,
        (("another bank base", "it is part of the map's version: no register tells it"),),
    ),
    Row(
        "M10",
        "a disturbed RTU line",
        "as M2; bytes that nobody asked for are counted",
        crossed(LINE_FAULTS, LINE_KINDS),
        _TEST,
        (("a foreign master refuses the push", _LATER),),
    ),
    Row(
        "M11",
        "one socket only, oldest kicked, accept-then-close, refused",
        "never two sockets; at most 8 attempts in the first 60 s; back-off ends only with a good answer",
        ("one socket only", "oldest kicked", "accept then close", "refused"),
        "test_modbus_reconnect.py",
    ),
)
