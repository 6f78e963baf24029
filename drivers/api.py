"""Capabilities of devices as small Protocols, and the plain values they return.

Lengths keep the unit of the wire (mm for commands, nm or 0.1 nm counts for raw readings), so that nothing is lost before storage; the
service turns raw counts into arrays in one place. ``host_s`` is the monotonic time of the host, s, when the last byte arrived.

A run stores the status word of a reading as the instrument sent it (docs/protocols); outside the drivers only functions of this file, such
as `bar_is_valid`, interpret its bits.
"""

from __future__ import annotations

import math
from collections.abc import AsyncIterator, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from enum import Flag, IntFlag, StrEnum, auto
from typing import NamedTuple, Protocol, TypeGuard

Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """Identity of a device."""

    kind: str
    model: str
    serial_no: str
    boot_id: int
    firmware: str


class BarSample(NamedTuple):
    """One ball-bar sample (docs/protocols/ballbar.md). A plain tuple: thousands are made every second.

    ``status``: bits of `abbe.drivers.api.BarFlag`; drivers of boxes with other status bits convert them.
    """

    seq: int
    device_us: int
    reading_nm: int
    status: int


@dataclass(frozen=True, slots=True)
class BarBatch:
    """Samples that arrived together. ``missing``: number of samples lost just before this batch, by their sequence numbers.

    ``boot_id``: boot id of the box. ``overran``: whether bytes were lost before these samples because this computer did not keep up.
    """

    host_s: float
    samples: tuple[BarSample, ...]
    missing: int = 0
    boot_id: int = 0
    overran: bool = False


class BarTap(Protocol):
    """Recorder of a stream. A thread of the driver passes every sample to the recorder before any consumer gets the sample."""

    def take(self, batch: BarBatch) -> None:
        """Take a batch, in order and exactly once. May block while the disk is slow: the driver buffers later samples. Never raises."""
        ...

    def warn(self, text: str) -> None:
        """Receive a warning that the driver's buffer fills up. Must not block."""
        ...


@dataclass(frozen=True, slots=True)
class LaserReading:
    """One coherent output sample of the laser (docs/protocols/laser.md).

    ``status``: bits of `abbe.drivers.api.LaserFlag`; drivers of instruments with other status bits convert them.
    ``refractivity``: n - 1 of air. Values of the air that the instrument does not measure are NaN (`air_doc`).
    """

    host_s: float
    sample_count: int
    device_us: int
    displacement_tenth_nm: int
    signal_permille: int
    status: int
    air_temp_c: float
    air_pressure_pa: float
    humidity_percent: float
    refractivity: float


class Condition(Flag):
    """Conditions of a controller. Drivers map their status bits to these; no device sends these numbers."""

    ESTOP = auto()
    DOOR_OPEN = auto()
    ALARM = auto()
    REMOTE = auto()
    REFERENCED = auto()
    DRIVES_ON = auto()
    MOVING = auto()
    IN_POSITION = auto()
    FEED_HOLD = auto()
    PATH_RUNNING = auto()
    COMPENSATION_ON = auto()
    NC_PROGRAM = auto()
    SPINDLE = auto()


NOTHING_HOLDS = Condition(0)
WRONG_STATES = {
    Condition.ESTOP: "the e-stop is pressed",
    Condition.DOOR_OPEN: "the door is open",
    Condition.ALARM: "there is an alarm",
    Condition.REMOTE: "not in remote mode",
    Condition.REFERENCED: "the axes are not referenced",
    Condition.DRIVES_ON: "the drives are off",
    Condition.MOVING: "an axis moves",
    Condition.PATH_RUNNING: "a path is running",
    Condition.NC_PROGRAM: "an NC program is running",
    Condition.SPINDLE: "the spindle turns",
}
"""What is wrong, in words, about a condition that has the state which a job forbids."""


@dataclass(frozen=True, slots=True)
class ControllerStatus:
    """One coherent status of a controller. Times ``_us`` are microseconds of its own clock.

    ``path_start_us``, ``path_end_us``: start and end of the last path; while a path runs, the end is smaller than the start.
    ``in_position_us``: when the axes last came to a stop.
    """

    host_s: float
    ctrl_us: int
    conditions: Condition
    position_mm: Point
    path_points_done: int
    path_start_us: int
    path_end_us: int
    override_percent: int
    in_position_us: int

    @property
    def moving(self) -> bool:
        """Whether an axis moves."""
        return Condition.MOVING in self.conditions

    @property
    def path_running(self) -> bool:
        """Whether a path runs."""
        return Condition.PATH_RUNNING in self.conditions

    @property
    def compensation_on(self) -> bool:
        """Whether compensation is on."""
        return Condition.COMPENSATION_ON in self.conditions

    @property
    def program_runs(self) -> bool:
        """Whether an NC program runs."""
        return Condition.NC_PROGRAM in self.conditions

    @property
    def remote(self) -> bool:
        """Whether the controller takes commands from us."""
        return Condition.REMOTE in self.conditions


@dataclass(frozen=True, slots=True)
class ProbeState:
    """A touch probe: whether it is in the spindle and ready, and whether its stylus is deflected now."""

    fitted: bool
    deflected: bool


@dataclass(frozen=True, slots=True)
class Latch:
    """Axis position at which the probe tripped, and the time of the trip, microseconds of the controller's clock.

    ``period_s``: period at which the control reads the probe; the trip was up to one period earlier. 0: the probe latches by itself.
    """

    position_mm: Point
    ctrl_us: int
    period_s: float = 0.0


class BankState(StrEnum):
    """State of a bank for compensation tables. Drivers map their own numbers to these."""

    EMPTY = "empty"
    WRITING = "being written"
    SEALED = "sealed"
    LAID_ASIDE = "laid aside"
    """The table is sealed; it takes effect after the control's next start."""
    OFF = "switched off"
    """Compensation is off, so the table does not act (controls with one table, `OneBank`)."""
    UNKNOWN = "unknown"
    """The controller reports a number that its driver does not know."""


@dataclass(frozen=True, slots=True)
class CompStatus:
    """One coherent status of the compensation banks: generation and boot id were the same before and after the read (seqlock).

    ``gen``: generation, a counter of all changes of the banks. ``bank_crc``: 0 for a bank that is not sealed. ``lease_owner``: 0 if there
    is no lease.
    """

    boot_id: int
    gen: int
    active_bank: int
    bank_crc: tuple[int, int]
    bank_state: tuple[BankState, BankState]
    lease_owner: int
    lease_left_ms: int


@dataclass(frozen=True, slots=True)
class TableFormat:
    """Storage format of a controller's tables: unit of a value, size of a bank."""

    lsb_nm: int
    bank_registers: int


class BallBar(Protocol):
    """A telescoping ball-bar."""

    @property
    def name(self) -> str: ...
    async def peek_boot_id(self) -> int | None: ...
    async def identify(self) -> DeviceInfo: ...
    async def make_ready(self, *, within_s: float) -> DeviceInfo: ...
    async def check(self, rate_hz: int, *, range_mm: float) -> None: ...
    def stream(self, rate_hz: int, tap: BarTap | None = None) -> AbstractAsyncContextManager[AsyncIterator[BarBatch]]: ...
    async def close(self) -> None: ...


class DisplacementMeter(Protocol):
    """A laser Doppler displacement meter or another displacement sensor; positive: the target moves away from the instrument.

    Every call has its own time-out. After a lost connection the driver connects again with the next call; the zero may be lost then.
    """

    async def identify(self) -> DeviceInfo:
        """Return kind, model and serial number; the serial number distinguishes two devices."""

    async def zero(self) -> None:
        """Make the present position 0. Raises DeviceFault where the device gives no valid reading."""

    async def clear_beam(self) -> None:
        """Clear the mark of a lost beam, if the device keeps one. The device must be zeroed again afterwards."""

    async def set_environment_compensation(self, on: bool) -> None:
        """Switch the device's correction of the wavelength for the air on or off; do nothing if the device has none."""

    async def read(self, *, after_count: int | None = None) -> LaserReading:
        """Wait for a sample whose ``sample_count`` is not ``after_count``; ``host_s`` is `time.monotonic` of its arrival.

        Raises
        ------
        DeviceFault
            The sample is not valid, or the zero was lost.
        ReplyTimeout
            No new sample came.
        LinkDown, BadFrame
            Communication failed.
        """

    async def peek(self) -> LaserReading:
        """Return the present sample, valid or not (`LaserFlag`), new or not."""

    async def close(self) -> None:
        """End the connection. Closing twice does nothing."""


class Identity(Protocol):
    """Identity and status of a controller: all requests that change nothing."""

    async def identify(self) -> DeviceInfo: ...
    async def status(self) -> ControllerStatus: ...
    async def comp_status(self) -> CompStatus: ...
    async def table_format(self) -> TableFormat: ...
    async def close(self) -> None: ...


class Motion(Protocol):
    """Straight moves, and stops of any motion."""

    async def status(self) -> ControllerStatus: ...
    async def move(self, target_mm: Point, *, feed_mm_min: float, timeout_s: float) -> ControllerStatus: ...
    async def hold(self) -> None: ...
    async def abort(self) -> None: ...


class Paths(Motion, Protocol):
    """Paths followed at constant feed."""

    async def load_path(self, points_mm: Sequence[Point]) -> None: ...
    async def start_path(self, *, feed_mm_min: float) -> None: ...


class Probing(Motion, Protocol):
    """Moves that a touch probe ends. ``touch`` returns the position of the trip, None if the probe reached the target without a trip."""

    async def probe_state(self) -> ProbeState: ...
    async def touch(self, target_mm: Point, *, feed_mm_min: float, timeout_s: float) -> Latch | None: ...


class Tables(Protocol):
    """Two banks for compensation tables, and the lease that allows changing them.

    A bank holds an image (`abbe.drivers.tables`); ``first`` counts its 16-bit words from 0.
    """

    async def lease(self, owner: int, lease_ms: int, *, anyway: bool = False) -> None: ...
    async def release(self, owner: int, *, anyway: bool = False) -> None: ...
    async def read_bank(self, bank: int, n_bytes: int | None = None, *, first: int = 0) -> bytes: ...
    async def write_bank(self, bank: int, data: bytes, *, first: int = 0) -> None: ...
    async def seal(self, bank: int, owner: int) -> None: ...
    async def activate(self, bank: int, *, expect_crc: int, expect_gen: int, owner: int) -> None: ...


class TableState(NamedTuple):
    """State of a control with one table. ``acts``: compensation is on."""

    boot_id: int
    acts: bool


class OneBank(Protocol):
    """A control with one table, which acts while its compensation is on. The table is an image (`abbe.drivers.tables`).

    ``write_table`` raises Refused while the table acts. ``switch`` is numbered, so that a late or repeated request does nothing; it raises
    Refused if the CRC-32 of the control's image is not ``expect_crc``, or if compensation is already in the wanted state. Compensation that
    is off stays off after a restart.
    """

    async def status(self) -> ControllerStatus: ...
    async def table_state(self) -> TableState: ...
    async def read_table(self) -> bytes: ...
    async def write_table(self, data: bytes, *, first: int) -> None: ...
    async def switch(self, *, on: bool, expect_crc: int) -> None: ...


class TableController(Identity, Tables, Protocol):
    """The part of a controller that is needed to write compensation tables: status and banks, but no motion."""


class Controller(Identity, Paths, Tables, Protocol):
    """All capabilities of a controller. Functions should require only the part that they need."""


def can_touch(controller: object) -> TypeGuard[Probing]:
    """Whether a control can end moves by a touch probe (`Probing`)."""
    return hasattr(controller, "touch") and hasattr(controller, "probe_state")


ONE_BANK = ("table_state", "read_table", "write_table", "switch")


def has_one_table(controller: object) -> bool:
    """Whether a control has one table in place of two banks (`OneBank`)."""
    return all(hasattr(controller, name) for name in ONE_BANK)


def only_listens(controller: Identity | Motion) -> bool:
    """Whether a control can only be listened to: it takes no motion commands and shows no compensation tables."""
    return bool(getattr(controller, "only_listens", False))


def resolution_mm(meter: DisplacementMeter) -> float:
    """Smallest step of a meter's readings, mm: from its device file or, without a device file, from docs/protocols/laser.md."""
    return float(getattr(meter, "resolution_mm", 1e-7))


class Fixture(Protocol):
    """Mounts bars and mirrors: the operator at the console, or a remote fixture (docs/protocols/fixture.md)."""

    async def identify(self) -> str: ...
    async def mount_ballbar(self, radius_mm: float) -> None: ...
    async def take_out_ballbar(self) -> None: ...
    async def change_ballbar(self, radius_mm: float) -> None: ...
    async def mount_laser(self, beam: Point) -> None: ...
    async def mount_artefact(self, origin_mm: Point, matrix: tuple[Point, Point, Point]) -> None: ...
    async def unmount(self) -> None: ...
    async def close(self) -> None: ...


class BarFlag(IntFlag):
    """Status of a ball-bar sample (docs/protocols/ballbar.md)."""

    OUT_OF_RANGE = 1 << 0
    OVERRUN = 1 << 2
    SYNC = 1 << 3
    NO_BAR = 1 << 4


class LaserFlag(IntFlag):
    """Status of a laser reading (docs/protocols/laser.md)."""

    BEAM_LOST = 1 << 0
    SIGNAL_LOW = 1 << 1
    ZEROED = 1 << 2
    COMPENSATED = 1 << 3
    NO_REFLECTOR = 1 << 4


# Plain integers: samples come 20,000 times a second, and operations on flags cost a microsecond each.
_SYNC, _OVERRUN, _ZEROED = int(BarFlag.SYNC), int(BarFlag.OVERRUN), int(LaserFlag.ZEROED)
_BAR_OUT = int(BarFlag.OUT_OF_RANGE | BarFlag.NO_BAR)
_BAR_INVALID = _BAR_OUT | _OVERRUN
_BAR_REASONS = ((int(BarFlag.OUT_OF_RANGE), "out of range"), (_OVERRUN, "samples lost just before"), (int(BarFlag.NO_BAR), "no bar"))
BAR_REASONS = tuple(reason for _, reason in _BAR_REASONS)
"""All reasons for an invalid ball-bar reading that the box can report."""
_BEAM_GONE = int(LaserFlag.BEAM_LOST | LaserFlag.NO_REFLECTOR)
_BEAM_BAD = _BEAM_GONE | int(LaserFlag.SIGNAL_LOW)
_COMPENSATED = int(LaserFlag.COMPENSATED)
_NO_SIGNAL = int(LaserFlag.SIGNAL_LOW | LaserFlag.NO_REFLECTOR)


def air_doc(reading: LaserReading) -> dict[str, float]:
    """Return air temperature and pressure of a reading as fields of its record; leave out what the instrument does not measure."""
    known = {"air_temp_c": reading.air_temp_c, "air_pressure_pa": reading.air_pressure_pa}
    return {name: value for name, value in known.items() if not math.isnan(value)}


def on_path(status: int) -> bool:
    """Whether the controller's path-running output was set when the bar was read."""
    return bool(status & _SYNC)


def bar_is_out(status: int) -> bool:
    """Whether the bar was out of range or absent."""
    return bool(status & _BAR_OUT)


def bar_is_valid(status: int) -> bool:
    """Whether the reading is valid: in range, a bar present, no samples lost just before."""
    return not status & _BAR_INVALID


def bar_reasons(status: int) -> list[str]:
    """Return the reasons why the reading is invalid; empty if it is valid."""
    return [reason for bit, reason in _BAR_REASONS if status & bit]


def overran(status: int) -> bool:
    """Whether the box lost samples just before this one."""
    return bool(status & _OVERRUN)


def beam_is_good(status: int) -> bool:
    """Whether the laser's reading is valid: the beam was not lost since the last zero, is strong enough, and has a reflector."""
    return not status & _BEAM_BAD


def beam_is_gone(status: int) -> bool:
    """Whether the beam was lost or has no reflector."""
    return bool(status & _BEAM_GONE)


def signal_is_there(status: int) -> bool:
    """Whether the laser now sees a reflector with a strong signal, regardless of earlier losses."""
    return not status & _NO_SIGNAL


def is_zeroed(status: int) -> bool:
    """Whether the laser was zeroed."""
    return bool(status & _ZEROED)


def air_is_compensated(status: int) -> bool:
    """Whether the laser corrects its reading for the air."""
    return bool(status & _COMPENSATED)
