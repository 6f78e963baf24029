"""Reasons to stop motion: requests of people (`Control`), conditions in the status of the machine (interlocks), and a controller that
was restarted or has another table.

A `Control` pauses, resumes, stops and aborts a measurement, and reports its state. Call it in the event loop of the measurement; from a
signal handler or another thread use ``loop.call_soon_threadsafe``.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Coroutine
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, TypeVar

from abbe.drivers.api import Condition, ControllerStatus, LaserReading, beam_is_gone, beam_is_good
from abbe.service.domain.progress import Progress
from abbe.service.errors import (
    Aborted,
    AlarmOn,
    BeamLost,
    DoorOpen,
    DrivesOff,
    EstopPressed,
    Interlock,
    PreconditionsChanged,
    ProgramRuns,
    RemoteLost,
    SpindleTurns,
    Stopped,
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
"""Conditions that mounting may cause; nothing moves while a person mounts."""
PAUSED = frozenset({"door", "mode", "drives", "program", "spindle", "temperature", "beam"})
"""Conditions that a person may cause during a pause; checked again before the measurement resumes."""
CAN_CLEAR = frozenset({"door", "beam", "temperature"})
"""Conditions that may suspend a run instead of ending it; all others, such as e-stop and alarm, end it."""


@dataclass(frozen=True, slots=True)
class Suspending:
    """Conditions (of `CAN_CLEAR`) that suspend a measurement until they clear; if there are none, every condition ends the run.

    ``longest_s``: longest suspension; ``settle_s``: how long all conditions must be clear before the measurement resumes (host s).
    """

    conditions: frozenset[str] = frozenset()
    longest_s: float = 1800.0
    settle_s: float = 10.0


@dataclass(frozen=True, slots=True)
class Watching:
    """Conditions and rate of the watcher. ``air_c``: allowed air temperature in degrees C, None: not watched.

    ``unknown_s``: longest silence of the controller; ``air_unknown_s``: longest silence of the laser while only the air is watched.
    """

    air_c: tuple[float, float] | None = None
    suspending: Suspending = field(default_factory=Suspending)
    period_s: float = 0.02
    unknown_s: float = 0.5
    air_unknown_s: float = 30.0


def tripped(status: ControllerStatus, tolerated: frozenset[str] = frozenset()) -> Interlock | None:
    """Return the interlock of the first condition that forbids motion; None: the machine may move."""
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
        raise ProgramRuns("an NC program runs", "wait until the program has ended, then start again; nothing was sent to the machine")
    if not status.remote:
        raise RemoteLost("the controller is not in remote mode", READY)


def person_may_be_inside(status: ControllerStatus) -> bool:
    """Return whether the door is open or the mode is not remote: a person may touch what is mounted."""
    return Condition.DOOR_OPEN in status.conditions or not status.remote


def beam_trouble(reading: LaserReading) -> BeamLost | None:
    """Return why the laser's count is not valid (the beam was lost, has no reflector, or is too weak); None: it is valid."""
    if beam_is_good(reading.status):
        return None
    what = "lost" if beam_is_gone(reading.status) else f"too weak ({reading.signal_permille} permille)"
    return BeamLost(f"the laser's beam is {what}", "free the beam; the test begins again with a new zero")


def air_trouble(reading: LaserReading, window_c: tuple[float, float] | None) -> TemperatureOutside | None:
    """Return the interlock for air outside the temperature window (degrees C); None if it is inside or not watched."""
    if window_c is None or window_c[0] <= reading.air_temp_c <= window_c[1]:
        return None
    low, high = window_c
    return TemperatureOutside(
        f"the air has {reading.air_temp_c:.1f} C, the limits are {low:g}..{high:g} C",
        "wait until the air is within these limits, then go on",
    )


@dataclass(frozen=True, slots=True)
class Prompt:
    """A manual task for a person. ``number`` is unique within one measurement and counts from 1."""

    number: int
    text: str


class Prompts:
    """Asks a person for manual work while the console is unattended, one task at a time."""

    def __init__(self) -> None:
        self._count = 0
        self._now: Prompt | None = None
        self._done: asyncio.Future[None] | None = None

    @property
    def now(self) -> Prompt | None:
        """The open prompt, or None."""
        return self._now

    async def ask(self, text: str) -> None:
        """Show a prompt and wait until a person confirms it. Cancelling the wait withdraws the prompt."""
        assert self._now is None, "one prompt at a time"
        self._count += 1
        self._now, self._done = Prompt(self._count, text), asyncio.get_running_loop().create_future()
        try:
            await self._done
        finally:
            self._now = self._done = None

    def answer(self, number: int) -> bool:
        """Confirm the open prompt. Returns False and changes nothing if ``number`` is not the number of the open prompt."""
        if self._now is None or self._done is None or self._now.number != number:
            return False
        self._now = None  # at once: a repeated confirmation has no effect
        if not self._done.done():
            self._done.set_result(None)
        return True


T = TypeVar("T")
STOPPED = Stopped("stopped as asked", "`abbe measure -m MACHINE.toml --resume CAMPAIGN` resumes it")
ABORTED = Aborted("aborted as asked: the axes were stopped where they were", "look at the machine, then `abbe measure --resume`")


class State(StrEnum):
    """State of a measurement."""

    READY = "ready"
    RUNNING = "running"
    PAUSING = "pausing"
    PAUSED = "paused"
    SUSPENDED = "suspended"
    STOPPING = "stopping"
    ABORTING = "aborting"
    ENDED = "ended"


class Control:
    """Pauses, resumes, stops and aborts one measurement."""

    def __init__(self) -> None:
        self._now = Progress(state=State.READY)
        self._pause = self._stop = self._abort = False
        self.no_pause_reason = ""
        """Why the measurement cannot pause now; empty: it can. Earlier requests stay in force: call `gate` first."""
        self.prompts = Prompts()
        """Prompts for a person who is not at the console."""
        self._asked = asyncio.Event()
        self._changed: asyncio.Event = asyncio.Event()

    # ---- requests of a person -------------------------------------------------------------------------------------

    def pause(self) -> None:
        """Pause at the next safe place: between points at once; a recorded path stops, and its rest or the whole path is measured later."""
        if not (self._stop or self._abort or self._pause or self.no_pause_reason):
            self._pause = True
            self._to(State.PAUSING)

    def resume(self) -> None:
        """Resume after a pause, once the preconditions are checked again."""
        if self._pause:
            self._pause = False
            if self._now.state == State.PAUSING:  # withdrawn before it took effect
                self._set(replace(self._now, state=State.RUNNING, why=""))
            self._ask()

    def stop(self) -> None:
        """Finish the current point or stop the path, then end; the current run is closed as stopped."""
        if not (self._stop or self._abort):
            self._stop, self._pause = True, False
            self._to(State.STOPPING)

    def abort(self) -> None:
        """Stop the axes at once and end; the current run is closed as aborted."""
        if not self._abort:
            self._abort, self._pause = True, False
            self._to(State.ABORTING)

    # ---- state for watchers ---------------------------------------------------------------------------------------

    @property
    def progress(self) -> Progress:
        """Current state, why the measurement waits, and how far the current test is."""
        return self._now

    @property
    def state(self) -> State:
        """Current state."""
        return State(self._now.state)

    async def watch(self) -> AsyncIterator[Progress]:
        """Yield the current state and every change until the measurement ends. A slow watcher skips states and gets the newest."""
        last: Progress | None = None
        while True:
            changed = self._changed
            if last is None or (self._now.state, self._now.why) != (last.state, last.why):
                last = self._now
                yield last
                if last.state == State.ENDED:
                    return
                continue
            await changed.wait()

    # ---- for the sequencer ----------------------------------------------------------------------------------------

    @property
    def pausing(self) -> bool:
        """Whether a pause is requested."""
        return self._pause

    @property
    def stopping(self) -> bool:
        """Whether a stop is requested."""
        return self._stop

    @property
    def aborting(self) -> bool:
        """Whether an abort is requested."""
        return self._abort

    def now(self, state: State, why: str = "") -> None:
        """Report the sequencer's state to watchers; while a request is pending they see the request instead."""
        asked = (State.ABORTING, self._abort), (State.STOPPING, self._stop), (State.PAUSING, self._pause and state == State.RUNNING)
        wanted = next((one for one, is_asked in asked if is_asked), state)
        self._set(replace(self._now, state=state if state == State.ENDED else wanted, why=why))

    def place(self, step: int, steps: int, points: int) -> None:
        """Note how far the current test is: step (from 1) and points read. Does not wake watchers."""
        self._now = replace(self._now, step=step, steps=steps, points=points)

    def check(self) -> None:
        """Raise ``Stopped`` or ``Aborted`` if a stop or an abort is requested."""
        if self._abort:
            raise Aborted(ABORTED.detail, ABORTED.remedy)
        if self._stop:
            raise Stopped(STOPPED.detail, STOPPED.remedy)

    async def gate(self) -> None:
        """Wait while a pause is requested. Call it between two pieces of work. Raises as `check`."""
        self.check()
        if self._pause:
            self.now(State.PAUSED)
            await self.resumed()
            self.now(State.RUNNING)

    async def asked(self) -> None:
        """Wait for the next request of a person."""
        event = self._asked
        await event.wait()

    async def resumed(self) -> None:
        """Wait until the pause is withdrawn. Raises as `check`."""
        while self._pause:
            await self.asked()
        self.check()

    async def aborted(self) -> None:
        """Wait for an abort, and raise ``Aborted``."""
        await self._until_aborted()
        self.check()

    async def _until_aborted(self) -> None:
        while not self._abort:
            await self.asked()

    async def unless_stopped(self, work: Awaitable[T]) -> T:
        """Wait for work of any length, e.g. a person's answer; a stop or an abort cancels it. Raises as `check`."""
        task = asyncio.ensure_future(work)
        try:
            while not task.done():
                event = self._asked  # before the check: every later request sets this event
                self.check()
                asked = asyncio.ensure_future(event.wait())
                try:
                    await asyncio.wait({task, asked}, return_when=asyncio.FIRST_COMPLETED)
                finally:
                    asked.cancel()
            return task.result()
        finally:
            if not task.done():
                task.cancel()
                await asyncio.wait({task})

    async def unless_aborted(self, work: Coroutine[Any, Any, T]) -> T:
        """Wait for work that handles a stop by itself; an abort cancels the work, whose clean-up always runs to the end.

        Raises
        ------
        Aborted
            An abort was requested; the error carries the notes of the work.
        """
        task, aborting = asyncio.create_task(work), asyncio.create_task(self._until_aborted())
        cancelled: asyncio.CancelledError | None = None
        try:
            while not task.done():
                try:
                    await asyncio.wait({task} if aborting.done() else {task, aborting}, return_when=asyncio.FIRST_COMPLETED)
                    ending = aborting.done() and not task.done() and not task.cancelling()
                except asyncio.CancelledError as error:
                    cancelled, ending = error, True
                if ending:
                    task.cancel()
        finally:
            aborting.cancel()
        return _ended(task, cancelled)

    def _to(self, state: State) -> None:
        if self._now.state not in (State.READY, State.ENDED):
            self._set(replace(self._now, state=state, why=""))
        self._ask()

    def _ask(self) -> None:
        event, self._asked = self._asked, asyncio.Event()
        event.set()

    def _set(self, now: Progress) -> None:
        self._now = now
        event, self._changed = self._changed, asyncio.Event()
        event.set()


def _ended(task: asyncio.Task[T], cancelled: asyncio.CancelledError | None) -> T:
    """Return the result of the work, or raise its error; a cancellation keeps the notes of the work."""
    if cancelled is None and not task.cancelled():
        return task.result()
    try:
        task.result()
    except asyncio.CancelledError as error:
        notes = getattr(error, "__notes__", [])
    except Exception as error:  # noqa: BLE001 - the cancellation wins; the error becomes a note of it
        notes = [str(error), *getattr(error, "__notes__", [])]
    else:
        notes = []
    ended: BaseException = cancelled if cancelled is not None else Aborted(ABORTED.detail, ABORTED.remedy)
    for note in notes:
        ended.add_note(note)
    raise ended


@dataclass(frozen=True, slots=True)
class ExpectedTable:
    """Boot id of the controller and CRC of the active table when the campaign began."""

    boot_id: int
    table_crc: int


def check_expected(expected: ExpectedTable, boot_id: int, table_crc: int) -> None:
    """Raise PreconditionsChanged if the controller was restarted or another table is active."""
    if boot_id != expected.boot_id:
        raise PreconditionsChanged(
            f"the controller was restarted since this campaign began (boot id {boot_id:#x} instead of {expected.boot_id:#x})",
            "its clock started again: measure a new campaign; the complete runs of this campaign are kept",
        )
    if table_crc != expected.table_crc:
        raise PreconditionsChanged(
            f"another compensation table is active (CRC {table_crc:08X} instead of {expected.table_crc:08X})",
            "make the old table active again, or measure a new campaign",
        )
