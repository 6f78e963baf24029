"""Which conditions forbid motion, read from what the devices say. Pure: no waiting, no sending."""

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
"""What a person may do who mounts something: nothing moves meanwhile."""
PAUSED = frozenset({"door", "mode", "drives", "program", "spindle", "temperature", "beam"})
"""What a person may do while the measurement is paused; looked at again before it goes on."""
CAN_CLEAR = frozenset({"door", "beam", "temperature"})
"""Conditions that may suspend instead of ending the run. E-stop and alarm never."""


@dataclass(frozen=True, slots=True)
class Suspending:
    """What suspends a measurement and lets it go on by itself. ``conditions``: of `CAN_CLEAR`; none: every condition ends the run.

    ``longest_s``: longest suspension; ``settle_s``: how long all must be well before it goes on (seconds of this computer).
    """

    conditions: frozenset[str] = frozenset()
    longest_s: float = 1800.0
    settle_s: float = 10.0


@dataclass(frozen=True, slots=True)
class Watching:
    """What the watcher looks at, and how often. ``air_c``: window of the air's temperature, None: not watched.

    ``unknown_s``: longest silence of the controller; ``air_unknown_s``: of the laser while only the air is asked of it.
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
    """Refuse to move (or to go on) unless the controller says that it is safe.

    Raises
    ------
    Interlock
        Which condition, and that nothing moves until it is cleared.
    """
    trouble = tripped(status)
    if trouble is not None:
        raise trouble


def check_ours(status: ControllerStatus) -> None:
    """Refuse to send anything, a stop included, to a machine that another program works with.

    Raises
    ------
    ProgramRuns, RemoteLost
        It runs its own program, or is not in remote mode.
    """
    if status.program_runs:
        raise ProgramRuns("an NC program runs", "wait until it has ended, then start again; nothing was sent to the machine")
    if not status.remote:
        raise RemoteLost("the controller is not in remote mode", READY)


def somebody_at_work(status: ControllerStatus) -> bool:
    """Whether the door is open or the mode is not remote: a person may touch what is mounted."""
    return Condition.DOOR_OPEN in status.conditions or not status.remote


def beam_trouble(reading: LaserReading) -> BeamLost | None:
    """Whether the laser's count can still be trusted: the beam was not lost, is strong enough and has a reflector."""
    if beam_is_good(reading.status):
        return None
    what = "lost" if beam_is_gone(reading.status) else f"too weak ({reading.signal_permille} permille)"
    return BeamLost(f"the laser's beam is {what}", "free the beam; the test begins again with a new zero")


def air_trouble(reading: LaserReading, window_c: tuple[float, float] | None) -> TemperatureOutside | None:
    """Whether the air is as warm as a measurement allows."""
    if window_c is None or window_c[0] <= reading.air_temp_c <= window_c[1]:
        return None
    low, high = window_c
    return TemperatureOutside(
        f"the air has {reading.air_temp_c:.1f} C, allowed are {low:g}..{high:g} C", "wait until the room is as it should be, then go on"
    )
