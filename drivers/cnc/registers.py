"""Register map of the CNC controller (docs/protocols/cnc.md) as data, and pure functions that encode and decode it."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntFlag

from abbe.drivers.api import NOTHING_HOLDS, WRONG_STATES, BankState, CompStatus, Condition, ControllerStatus, Latch, Point, ProbeState
from abbe.drivers.links.words import Register, RegisterBlock, words_of

MAP_VERSION = 1
COUNTS_PER_MM = 100_000  # 10 nm
FEED_PER_MM_MIN = 100  # 0.01 mm/min
MAX_CHUNK = 19

IDENTITY = RegisterBlock(
    0,
    13,
    (
        Register(0, "i32", "CANARY_I32"),
        Register(2, "u32", "CANARY_F32"),
        Register(4, "u16", "MAP_VER"),
        Register(5, "u32", "BOOT_ID"),
        Register(7, "u32", "GEN"),
        Register(9, "u16", "N_AXES"),
        Register(10, "u16", "TABLE_LSB_NM", 1.0, "nm"),
        Register(11, "u16", "BANK_SIZE"),
        Register(12, "u16", "FIFO_SIZE"),
    ),
)
SEQLOCK = RegisterBlock(5, 4, (Register(5, "u32", "BOOT_ID"), Register(7, "u32", "GEN")), lead=5)

STATUS = RegisterBlock(
    16,
    48,
    (
        Register(16, "u64", "CTRL_TIME_US", 1e6, "s"),
        Register(20, "u32", "STATUS_BITS"),
        Register(22, "u16", "ALARM_CODE"),
        Register(23, "u16", "MOTION_ACK_SEQ"),
        Register(24, "u16", "MOTION_RESULT"),
        Register(25, "u16", "MOTION_DONE_SEQ"),
        Register(26, "i32", "POSITION_X", COUNTS_PER_MM, "mm"),
        Register(28, "i32", "POSITION_Y", COUNTS_PER_MM, "mm"),
        Register(30, "i32", "POSITION_Z", COUNTS_PER_MM, "mm"),
        Register(32, "u16", "FIFO_FREE"),
        Register(33, "u32", "PATH_POINTS_DONE"),
        Register(35, "u64", "PATH_START_US", 1e6, "s"),
        Register(39, "u64", "PATH_END_US", 1e6, "s"),
        Register(43, "u16", "OVERRIDE", 1.0, "%"),
        Register(44, "u64", "IN_POSITION_US", 1e6, "s"),
        Register(48, "u16", "FIFO_ACK_SEQ"),
        Register(49, "u16", "FIFO_RESULT"),
        Register(50, "u16", "PROBE_BITS"),
        Register(51, "i32", "LATCH_X", COUNTS_PER_MM, "mm"),
        Register(53, "i32", "LATCH_Y", COUNTS_PER_MM, "mm"),
        Register(55, "i32", "LATCH_Z", COUNTS_PER_MM, "mm"),
        Register(57, "u64", "LATCH_US", 1e6, "s"),
        Register(61, "u16", "LATCH_SEQ"),
        Register(62, "u16", "LATCH_PERIOD", 1e6, "s"),
    ),
    lead=16,
)

COMP_STATUS = RegisterBlock(
    208,
    16,
    (
        Register(208, "u16", "ACTIVE_BANK"),
        Register(209, "u32", "BANK_CRC_0"),
        Register(211, "u32", "BANK_CRC_1"),
        Register(213, "u16", "BANK_STATE_0"),
        Register(214, "u16", "BANK_STATE_1"),
        Register(215, "u16", "COMP_ACK_SEQ"),
        Register(216, "u16", "COMP_RESULT"),
        Register(217, "u32", "LEASE_OWNER"),
        Register(219, "u32", "LEASE_LEFT_MS", 1000.0, "s"),
    ),
)

MOTION_ADDRESS, HOLD_ADDRESS, FIFO_ADDRESS, COMP_ADDRESS = 64, 80, 96, 230
BANK_BASE = (1000, 6000)
BANK_REGISTERS = 4800
AXES = 3

MOVE, PATH_CLEAR, PATH_START, RESET_ALARM, TOUCH = 1, 2, 3, 4, 5
RUN, HOLD, ABORT = 0, 1, 2
SEAL, ACTIVATE, LEASE, RELEASE = 1, 2, 3, 4

MOTION_RESULT = {
    1: "bad argument",
    2: "interlock",
    3: "target beyond the strokes",
    4: "FIFO full",
    5: "busy moving",
    6: "no touch probe is fitted, or its stylus is deflected",
}
COMP_RESULT = {
    1: "bad argument",
    2: "interlock: the machine moves or is not ready",
    3: "the bank's CRC differs from the expected one",
    4: "the generation differs: another program or the operator changed a bank",
    5: "the bank is active",
    6: "the bank holds no valid image",
    7: "another owner holds the lease, or it is free",
    8: "staged: it takes effect after the control's restart, until then the other bank acts",
}
BANK_STATES = {0: BankState.EMPTY, 1: BankState.WRITING, 2: BankState.SEALED, 3: BankState.LAID_ASIDE}
ALARM = {1: "e-stop", 2: "stroke limit", 3: "path ran empty", 4: "the stylus was driven into something"}


class Bit(IntFlag):
    """Bits of the controller's register STATUS_BITS."""

    ESTOP = 1 << 0
    DOOR_OPEN = 1 << 1
    ALARM = 1 << 2
    REMOTE = 1 << 3
    REFERENCED = 1 << 4
    DRIVES_ON = 1 << 5
    MOVING = 1 << 6
    IN_POSITION = 1 << 7
    FEED_HOLD = 1 << 8
    PATH_RUNNING = 1 << 9
    COMPENSATION_ON = 1 << 10
    NC_PROGRAM = 1 << 11
    SPINDLE = 1 << 12


_CONDITIONS = {bit: Condition[bit.name] for bit in Bit if bit.name is not None}
_MUST_BE_CLEAR = Condition.ESTOP | Condition.DOOR_OPEN | Condition.ALARM | Condition.NC_PROGRAM
_MUST_BE_SET = Condition.REMOTE | Condition.REFERENCED | Condition.DRIVES_ON


def fingerprint(counts: Mapping[str, int]) -> str:
    """Describe the register map by the decoded identity block; different maps give different texts."""
    return (
        f"map {counts['MAP_VER']}, {counts['N_AXES']} axes, table unit {counts['TABLE_LSB_NM']} nm, "
        f"bank of {counts['BANK_SIZE']} registers, FIFO of {counts['FIFO_SIZE']} points"
    )


def conditions_of(bits: int) -> Condition:
    """Convert STATUS_BITS to conditions; ignore bits unknown to this map."""
    found = NOTHING_HOLDS
    for bit, condition in _CONDITIONS.items():
        if bits & bit:
            found |= condition
    return found


def interlocks(conditions: Condition) -> list[str]:
    """Describe the unmet conditions for motion; empty if the machine may move."""
    return [WRONG_STATES[one] for one in (*(_MUST_BE_CLEAR & conditions), *(_MUST_BE_SET & ~conditions))]


@dataclass(frozen=True, slots=True)
class StatusBlock:
    """Registers 16..63: the controller's status and the outcome of its commands.

    ``fifo_free``: free points of its path memory; ``latch``: position at which the probe tripped in motion command ``latch_seq``.
    """

    status: ControllerStatus
    alarm_code: int
    motion_ack_seq: int
    motion_result: int
    motion_done_seq: int
    fifo_free: int
    fifo_ack_seq: int
    fifo_result: int
    probe: ProbeState
    latch: Latch
    latch_seq: int


def decode_status(words: Sequence[int], host_s: float) -> StatusBlock:
    """Decode registers 16..63, read in one request; ``host_s``: monotonic time at which the reply was complete."""
    counts = STATUS.counts(words)
    x, y, z = (STATUS.physical(name, counts[name]) for name in ("POSITION_X", "POSITION_Y", "POSITION_Z"))
    u, v, w = (STATUS.physical(name, counts[name]) for name in ("LATCH_X", "LATCH_Y", "LATCH_Z"))
    status = ControllerStatus(
        host_s=host_s,
        ctrl_us=counts["CTRL_TIME_US"],
        conditions=conditions_of(counts["STATUS_BITS"]),
        position_mm=(x, y, z),
        path_points_done=counts["PATH_POINTS_DONE"],
        path_start_us=counts["PATH_START_US"],
        path_end_us=counts["PATH_END_US"],
        override_percent=counts["OVERRIDE"],
        in_position_us=counts["IN_POSITION_US"],
    )
    return StatusBlock(
        status=status,
        alarm_code=counts["ALARM_CODE"],
        motion_ack_seq=counts["MOTION_ACK_SEQ"],
        motion_result=counts["MOTION_RESULT"],
        motion_done_seq=counts["MOTION_DONE_SEQ"],
        fifo_free=counts["FIFO_FREE"],
        fifo_ack_seq=counts["FIFO_ACK_SEQ"],
        fifo_result=counts["FIFO_RESULT"],
        probe=ProbeState(fitted=bool(counts["PROBE_BITS"] & 1), deflected=bool(counts["PROBE_BITS"] & 2)),
        latch=Latch((u, v, w), counts["LATCH_US"], STATUS.physical("LATCH_PERIOD", counts["LATCH_PERIOD"])),
        latch_seq=counts["LATCH_SEQ"],
    )


def bank_state(number: int) -> BankState:
    """Return the state of a bank from the content of register BANK_STATE_0 or BANK_STATE_1."""
    return BANK_STATES.get(number, BankState.UNKNOWN)


def decode_comp_status(words: Sequence[int], *, boot_id: int, gen: int) -> CompStatus:
    """Decode registers 208..223, read in one request; boot id and generation were read before and after it."""
    counts = COMP_STATUS.counts(words)
    return CompStatus(
        boot_id=boot_id,
        gen=gen,
        active_bank=counts["ACTIVE_BANK"],
        bank_crc=(counts["BANK_CRC_0"], counts["BANK_CRC_1"]),
        bank_state=(bank_state(counts["BANK_STATE_0"]), bank_state(counts["BANK_STATE_1"])),
        lease_owner=counts["LEASE_OWNER"],
        lease_left_ms=counts["LEASE_LEFT_MS"],
    )


def position_counts(point_mm: Point) -> tuple[int, int, int]:
    """Convert a position in mm to counts of 10 nm. Raises ValueError for values that are not finite or beyond +-21 m."""
    if not all(math.isfinite(value) and abs(value) <= 21_000.0 for value in point_mm):
        raise ValueError(f"{point_mm} is not a position: three finite numbers in mm, at most +-21 m")
    x, y, z = (round(value * COUNTS_PER_MM) for value in point_mm)
    return x, y, z


def encode_motion(number: int, command: int, target: tuple[int, int, int] = (0, 0, 0), feed_mm_min: float = 0.0) -> tuple[int, ...]:
    """Build registers 64..73 of a motion command; ``target`` in counts. Raises ValueError for a feed that the register cannot hold."""
    if not (math.isfinite(feed_mm_min) and 0 <= feed_mm_min * FEED_PER_MM_MIN <= 0xFFFFFFFF):
        raise ValueError(f"{feed_mm_min} mm/min is not a feed")
    return words_of(struct.pack(">HHiiiI", number, command, *target, round(feed_mm_min * FEED_PER_MM_MIN)))


def encode_fifo(number: int, points: Sequence[tuple[int, int, int]]) -> tuple[int, ...]:
    """Build registers 96 and following for 1..19 path points in counts."""
    if not 1 <= len(points) <= MAX_CHUNK:
        raise ValueError(f"a chunk has 1..{MAX_CHUNK} points, not {len(points)}")
    flat = [value for point in points for value in point]
    return words_of(struct.pack(f">HH{len(flat)}i", number, len(points), *flat))


def encode_comp(
    number: int, command: int, *, bank: int = 0, expect_crc: int = 0, expect_gen: int = 0, owner: int = 0, lease_ms: int = 0
) -> tuple[int, ...]:
    """Build registers 230..240 of a compensation command. Raises ValueError if a value does not fit its register."""
    try:
        return words_of(struct.pack(">HHHIIII", number, command, bank, expect_crc, expect_gen, owner, lease_ms))
    except struct.error as error:
        raise ValueError(f"compensation command: {error}") from None
