"""Control of a measurement from outside: pause, resume, stop, abort, and a state that can be watched.

All calls belong into the event loop of the measurement; from a signal handler or another thread use ``loop.call_soon_threadsafe``.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Coroutine
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, TypeVar

from abbe.service.domain.progress import Progress
from abbe.service.errors import Aborted, Stopped

# What a measurement asks a person to do when its console is unattended, and the word that it is done: for the prompt that stands alone.
#
# All calls belong into the event loop of the measurement.


@dataclass(frozen=True, slots=True)
class Prompt:
    """Something to be done by hand. ``number`` counts from 1 within one measurement, and no number comes twice."""

    number: int
    text: str


class Prompts:
    """Asks for one thing at a time."""

    def __init__(self) -> None:
        self._count = 0
        self._now: Prompt | None = None
        self._done: asyncio.Future[None] | None = None

    @property
    def now(self) -> Prompt | None:
        """What is waited for; None: nothing."""
        return self._now

    async def ask(self, text: str) -> None:
        """Wait until a person says that it is done. Cancelling the wait withdraws the request."""
        assert self._now is None, "one thing at a time"
        self._count += 1
        self._now, self._done = Prompt(self._count, text), asyncio.get_running_loop().create_future()
        try:
            await self._done
        finally:
            self._now = self._done = None

    def answer(self, number: int) -> bool:
        """Take the word that a prompt is done; False: it is not the one that stands, and nothing happens."""
        if self._now is None or self._done is None or self._now.number != number:
            return False
        self._now = None  # at once: the same word a second time answers nothing
        if not self._done.done():
            self._done.set_result(None)
        return True


T = TypeVar("T")
STOPPED = Stopped("stopped as asked", "`abbe measure MACHINE.toml --resume CAMPAIGN` goes on from here")
ABORTED = Aborted("aborted as asked: the axes were stopped where they were", "look at the machine, then `abbe measure --resume`")


class State(StrEnum):
    """What a measurement is doing."""

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
        self.hurry = ""
        """Why it cannot be paused now; empty: it can. What was asked for before stays asked for: look at `gate` first."""
        self.prompts = Prompts()
        """What is asked of a person who is not at the console."""
        self._asked = asyncio.Event()
        self._changed: asyncio.Event = asyncio.Event()

    # ---- what a person asks for -----------------------------------------------------------------------------------

    def pause(self) -> None:
        """Hold at the next safe place: between points at once; a path that is being recorded is held and measured again later."""
        if not (self._stop or self._abort or self._pause or self.hurry):
            self._pause = True
            self._to(State.PAUSING)

    def resume(self) -> None:
        """Go on after a pause, once the preconditions were looked at again."""
        if self._pause:
            self._pause = False
            if self._now.state == State.PAUSING:  # taken back before it took effect
                self._set(replace(self._now, state=State.RUNNING, why=""))
            self._ask()

    def stop(self) -> None:
        """Finish the point in hand, or hold the path, then end: the run in hand is closed as stopped."""
        if not (self._stop or self._abort):
            self._stop, self._pause = True, False
            self._to(State.STOPPING)

    def abort(self) -> None:
        """Stop the axes at once and end: the run in hand is closed as aborted."""
        if not self._abort:
            self._abort, self._pause = True, False
            self._to(State.ABORTING)

    # ---- what can be watched --------------------------------------------------------------------------------------

    @property
    def progress(self) -> Progress:
        """State now, why it waits, and how far the test in hand is."""
        return self._now

    @property
    def state(self) -> State:
        """State now."""
        return State(self._now.state)

    async def watch(self) -> AsyncIterator[Progress]:
        """Every state from now on, the present one first; ends with the measurement. A slow watcher sees the newest, not all."""
        seen: Progress | None = None
        while True:
            changed = self._changed
            if seen is None or (self._now.state, self._now.why) != (seen.state, seen.why):
                seen = self._now
                yield seen
                if seen.state == State.ENDED:
                    return
                continue
            await changed.wait()

    # ---- what the sequencer asks ----------------------------------------------------------------------------------

    @property
    def pausing(self) -> bool:
        """A pause was asked for."""
        return self._pause

    @property
    def stopping(self) -> bool:
        """A stop was asked for."""
        return self._stop

    @property
    def aborting(self) -> bool:
        """An abort was asked for."""
        return self._abort

    def now(self, state: State, why: str = "") -> None:
        """Tell watchers what the sequencer does; what was asked for meanwhile stays visible."""
        asked = (State.ABORTING, self._abort), (State.STOPPING, self._stop), (State.PAUSING, self._pause and state == State.RUNNING)
        wanted = next((one for one, is_asked in asked if is_asked), state)
        self._set(replace(self._now, state=state if state == State.ENDED else wanted, why=why))

    def place(self, step: int, steps: int, points: int) -> None:
        """Note how far the test in hand is: step (from 1) and points read. Watchers are not woken for it."""
        self._now = replace(self._now, step=step, steps=steps, points=points)

    def check(self) -> None:
        """End here if that was asked for.

        Raises
        ------
        Stopped, Aborted
            It was.
        """
        if self._abort:
            raise Aborted(ABORTED.detail, ABORTED.remedy)
        if self._stop:
            raise Stopped(STOPPED.detail, STOPPED.remedy)

    async def gate(self) -> None:
        """A safe place between two pieces of work: wait here, or end, if that was asked for.

        Raises
        ------
        Stopped, Aborted
            It was.
        """
        self.check()
        if self._pause:
            self.now(State.PAUSED)
            await self.resumed()
            self.now(State.RUNNING)

    async def asked(self) -> None:
        """Wait until a person asks for something."""
        event = self._asked
        await event.wait()

    async def resumed(self) -> None:
        """Wait until a pause is taken back.

        Raises
        ------
        Stopped, Aborted
            That was asked for instead.
        """
        while self._pause:
            await self.asked()
        self.check()

    async def aborted(self) -> None:
        """Wait for an abort, and raise it."""
        await self._until_aborted()
        self.check()

    async def _until_aborted(self) -> None:
        while not self._abort:
            await self.asked()

    async def unless_stopped(self, work: Awaitable[T]) -> T:
        """Wait for something that a person does, or until stopped: then the work is cancelled.

        Raises
        ------
        Stopped, Aborted
            That was asked for.
        """
        task = asyncio.ensure_future(work)
        try:
            while not task.done():
                event = self._asked  # before looking: what is asked for from here on sets this one
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
        """Wait for work that ends by itself where it is stopped; an abort cancels it. Whatever it does on its way out is waited for.

        Raises
        ------
        Aborted
            That was asked for; its notes are those of the work.
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
    """What became of work that may have been cancelled, with what it has to say."""
    if cancelled is None and not task.cancelled():
        return task.result()
    try:
        task.result()
    except asyncio.CancelledError as error:
        notes = getattr(error, "__notes__", [])
    except Exception as error:  # noqa: BLE001 - who cancelled it waits for nothing else any more, but may hear of it
        notes = [str(error), *getattr(error, "__notes__", [])]
    else:
        notes = []
    ended: BaseException = cancelled if cancelled is not None else Aborted(ABORTED.detail, ABORTED.remedy)
    for note in notes:
        ended.add_note(note)
    raise ended
