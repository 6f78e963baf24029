"""Which conditions forbid motion, read from device status. Pure: no waiting, no sending."""

from __future__ import annotations

from dataclasses import dataclass, field

from abbe.drivers.api import Condition, ControllerStatus, LaserReading
from abbe.drivers.flags import beam_is_gone, beam_is_good
from abbe.service.errors import (
    AlarmOn,
    BeamLost,
    DoorOpen,
    DrivesOff,
    EstopPressed,
    Interlock,
    ProgramRuns,
    RemoteLost,
    SpindleTurns,
    TemperatureOutside,
)

CLEAR_IT = "clear it at the machine, then start again; the run so far is kept as incomplete"
READY = "make the machine ready, then start again"
FORBIDDEN: tuple[tuple[Condition, type[Interlock], str], ...] = (
    (Condition.ESTOP, EstopPressed, "e-stop is pressed"),
    (Condition.DOOR_OPEN, DoorOpen, "the door is open"),
    (Condition.ALARM, AlarmOn, "the controller has an alarm"),
    (Condition.NC_PROGRAM, ProgramRuns, "an NC program runs"),
    (Condition.SPINDLE, SpindleTurns, "the spindle turns"),
)
NEEDED: tuple[tuple[Condition, type[Interlock], str], ...] = (
    (Condition.REMOTE, RemoteLost, "the controller is not in remote mode"),
    (Condition.REFERENCED, DrivesOff, "the axes are not referenced"),
    (Condition.DRIVES_ON, DrivesOff, "the drives are off"),
)

AT_WORK = frozenset({"door"})
"""Conditions that mounting may cause; nothing moves during it."""
PAUSED = frozenset({"door", "mode", "drives", "program", "spindle", "temperature", "beam"})
"""Conditions that a person may cause during a pause; checked again before the measurement resumes."""
CAN_CLEAR = frozenset({"door", "beam", "temperature"})
"""Conditions that may suspend a run instead of ending it. E-stop and alarm never do."""


@dataclass(frozen=True, slots=True)
class Suspending:
    """Conditions (of `CAN_CLEAR`) that suspend a measurement until they clear; without any, every condition ends the run.

    ``longest_s``: longest suspension; ``settle_s``: how long all conditions must be clear before the measurement resumes (host s).
    """

    conditions: frozenset[str] = frozenset()
    longest_s: float = 1800.0
    settle_s: float = 10.0


@dataclass(frozen=True, slots=True)
class Watching:
    """What the watcher checks, and how often. ``air_c``: allowed air temperature in degrees C, None: not watched.

    ``unknown_s``: longest silence of the controller; ``air_unknown_s``: longest silence of the laser while only the air is watched.
    """

    air_c: tuple[float, float] | None = None
    suspending: Suspending = field(default_factory=Suspending)
    period_s: float = 0.02
    unknown_s: float = 0.5
    air_unknown_s: float = 30.0


def tripped(status: ControllerStatus, tolerated: frozenset[str] = frozenset()) -> Interlock | None:
    """The first condition of the controller that forbids motion; None: it may move."""
    for condition, kind, text in FORBIDDEN:
        if condition in status.conditions and kind.condition not in tolerated:
            return kind(text, CLEAR_IT)
    for condition, kind, text in NEEDED:
        if condition not in status.conditions and kind.condition not in tolerated:
            return kind(text, READY)
    return None


def check_interlocks(status: ControllerStatus) -> None:
    """Raise the ``Interlock`` of the first condition that forbids motion."""
    trouble = tripped(status)
    if trouble is not None:
        raise trouble


def check_ours(status: ControllerStatus) -> None:
    """Refuse to send anything, a stop included, to a machine that another program controls.

    Raises
    ------
    ProgramRuns, RemoteLost
        The controller runs an NC program, or is not in remote mode.
    """
    if status.program_runs:
        raise ProgramRuns("an NC program runs", "wait until it has ended, then start again; nothing was sent to the machine")
    if not status.remote:
        raise RemoteLost("the controller is not in remote mode", READY)


def person_may_be_inside(status: ControllerStatus) -> bool:
    """Whether the door is open or the mode is not remote: a person may touch what is mounted."""
    return Condition.DOOR_OPEN in status.conditions or not status.remote


def beam_trouble(reading: LaserReading) -> BeamLost | None:
    """Return why the laser's count is not valid: beam lost, too weak or without reflector; None: it is valid."""
    if beam_is_good(reading.status):
        return None
    what = "lost" if beam_is_gone(reading.status) else f"too weak ({reading.signal_permille} permille)"
    return BeamLost(f"the laser's beam is {what}", "free the beam; the test begins again with a new zero")


def air_trouble(reading: LaserReading, window_c: tuple[float, float] | None) -> TemperatureOutside | None:
    """Return the interlock of an air temperature outside the window (degrees C); None: inside, or not watched."""
    if window_c is None or window_c[0] <= reading.air_temp_c <= window_c[1]:
        return None
    low, high = window_c
    return TemperatureOutside(
        f"the air has {reading.air_temp_c:.1f} C, allowed are {low:g}..{high:g} C", "wait until the room is as it should be, then go on"
    )
