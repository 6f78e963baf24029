"""Meaning of the status word of stored readings (docs/protocols).

A run stores the word itself; outside the drivers only this module interprets its bits.
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
"""All reasons for an invalid ball-bar reading that the box can report."""
_BEAM_GONE = int(LaserFlag.BEAM_LOST | LaserFlag.NO_REFLECTOR)
_BEAM_BAD = _BEAM_GONE | int(LaserFlag.SIGNAL_LOW)
_COMPENSATED = int(LaserFlag.COMPENSATED)
_NO_SIGNAL = int(LaserFlag.SIGNAL_LOW | LaserFlag.NO_REFLECTOR)


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
    """Reasons why the reading is invalid; empty if it is valid."""
    return [reason for bit, reason in _BAR_REASONS if status & bit]


def overran(status: int) -> bool:
    """Whether the box lost samples just before this one."""
    return bool(status & _OVERRUN)


def beam_is_good(status: int) -> bool:
    """Whether the laser's count is valid: beam never lost since the zero, strong enough, a reflector present."""
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
