"""What the status word of a reading says, for readings that were stored as the instrument sent them (docs/protocols).

A run keeps the word itself; what its bits mean stands here and nowhere else outside the drivers.
"""

from __future__ import annotations

from enum import IntFlag


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
_BAR_REASONS = ((int(BarFlag.OUT_OF_RANGE), "out of range"), (_OVERRUN, "samples lost before it"), (int(BarFlag.NO_BAR), "no bar"))
BAR_REASONS = tuple(reason for _, reason in _BAR_REASONS)
"""Why a reading of the ball-bar is none: everything that the box can say."""
_BEAM_GONE = int(LaserFlag.BEAM_LOST | LaserFlag.NO_REFLECTOR)
_BEAM_BAD = _BEAM_GONE | int(LaserFlag.SIGNAL_LOW)
_COMPENSATED = int(LaserFlag.COMPENSATED)
_NO_SIGNAL = int(LaserFlag.SIGNAL_LOW | LaserFlag.NO_REFLECTOR)


def on_path(status: int) -> bool:
    """Whether the controller's path-running output was set when the bar was read."""
    return bool(status & _SYNC)


def bar_is_out(status: int) -> bool:
    """Whether the bar was out of range or not there."""
    return bool(status & _BAR_OUT)


def bar_is_valid(status: int) -> bool:
    """Whether the box says that the reading is one: in range, a bar there, no samples lost just before."""
    return not status & _BAR_INVALID


def bar_reasons(status: int) -> list[str]:
    """Why the box says that the reading is none, in words; empty where it is one."""
    return [reason for bit, reason in _BAR_REASONS if status & bit]


def overran(status: int) -> bool:
    """Whether the box lost samples just before this one."""
    return bool(status & _OVERRUN)


def beam_is_good(status: int) -> bool:
    """Whether the laser's count can be trusted: beam never lost since the zero, strong enough, a reflector there."""
    return not status & _BEAM_BAD


def beam_is_gone(status: int) -> bool:
    """Whether the beam was lost or has no reflector."""
    return bool(status & _BEAM_GONE)


def signal_is_there(status: int) -> bool:
    """Whether the laser sees a reflector with a strong signal now, whatever was before."""
    return not status & _NO_SIGNAL


def is_zeroed(status: int) -> bool:
    """Whether the laser's count begins at a zero that was asked for."""
    return bool(status & _ZEROED)


def air_is_compensated(status: int) -> bool:
    """Whether the laser corrects its reading for the air."""
    return bool(status & _COMPENSATED)
