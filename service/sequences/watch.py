"""The watcher beside a running test: polls controller and laser, and ends the test at an interlock or when a device does not answer.

The latency from an event to the end of the motion command stream is one period, one exchange, and the stop. The controller's link carries
one request at a time, so the watcher waits its turn and never has more than one request pending. While other tasks poll more often (along a
path), the watcher uses their answers, and asks only when the latest is a period old.

`incidents_noted` writes link incidents during a measurement into the campaign's journal, in a task of its own: no link waits for the
database.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Iterator
from contextlib import ExitStack, asynccontextmanager, contextmanager, suppress
from datetime import timedelta
from functools import partial
from typing import Any, Self

from abbe.drivers.api import ControllerStatus, DisplacementMeter
from abbe.drivers.errors import NO_RUN, DriverError, Rebooted, on_behalf_of, run_to_end
from abbe.drivers.links.incidents import Incident, Incidents
from abbe.service.clock import Clock
from abbe.service.devices.session import Session, latest_status
from abbe.service.errors import Interlock, MeasurementFault, StatusUnknown
from abbe.service.sequences.control import Control, Watching, air_trouble, beam_trouble, tripped
from abbe.service.sequences.journal import INCIDENT, OUTCOME, Journal

AIR_PERIOD_S = 1.0
LASER_UNKNOWN_S = 2.5
"""Longest silence of the laser: on a serial line one lost reply costs a second, and only readings depend on the laser."""
RETRY_S = 0.02
LATE_S = 0.1
"""A wake-up that is later than this, s, means that this computer stalled: the watcher asks once more before it calls the status unknown."""
LOOK_S = 0.05
"""Time between two checks for a stall of this computer."""
NOTHING: frozenset[str] = frozenset()
END_S = 5.0
"""Longest wait for the watchers' current poll when the test has ended."""


class Watch:
    """Watches controller and laser. The sequencer sets which conditions a person may cause now (``tolerated``) and whether the beam matters
    (``beam``)."""

    def __init__(self, session: Session, watching: Watching) -> None:
        self._s, self._w = session, watching
        self._ended = asyncio.Event()
        self._tolerated, self._since_s = NOTHING, time.monotonic()
        self.beam = False

    @property
    def tolerated(self) -> frozenset[str]:
        """Conditions that a person may cause now."""
        return self._tolerated

    @tolerated.setter
    def tolerated(self, conditions: frozenset[str]) -> None:
        self._tolerated, self._since_s = conditions, time.monotonic()  # earlier statuses are not judged by the new set

    def end(self) -> None:
        """Let the watchers end after their current poll."""
        self._ended.set()

    async def controller(self) -> None:
        """Poll the controller until the test ends.

        Raises
        ------
        Interlock
            A condition forbids motion, or the controller was silent for too long.
        Rebooted
            The controller restarted.
        """
        while not self._ended.is_set():
            status = self._just_heard()
            left_s = self._w.period_s if status is None else status.host_s + self._w.period_s - time.monotonic()
            if status is None:
                status = await known_status(self._s.controller.status, self._w.unknown_s)
            self._raise(tripped(status, self.tolerated))
            await self._rest(left_s)

    def _just_heard(self) -> ControllerStatus | None:
        """Return the status that another task read less than a period ago, or None."""
        status = latest_status(self._s.controller)
        if status is None or status.host_s <= max(self._since_s, time.monotonic() - self._w.period_s):
            return None
        return status

    async def laser(self, laser: DisplacementMeter) -> None:
        """Poll the laser until the test ends: the beam while `beam` is true, the air if its temperature is watched.

        Raises
        ------
        Interlock
            Beam lost, air outside the window, or the laser was silent for too long.
        """
        clock = asyncio.get_running_loop().time
        heard_s = clock()
        while not self._ended.is_set():
            if not self.beam and self._w.air_c is None:
                heard_s = clock()
                await self._rest(self._w.period_s)
                continue
            try:
                reading = await laser.peek()
            except Rebooted:
                raise
            except DriverError as error:
                longest_s = LASER_UNKNOWN_S if self.beam else self._w.air_unknown_s
                if clock() - heard_s > longest_s:
                    raise StatusUnknown(f"the laser has not answered for {longest_s:g} s: {error}", "look at its cable") from error
                await self._rest(RETRY_S)
                continue
            heard_s = clock()
            if self.beam:
                self._raise(beam_trouble(reading))
            self._raise(air_trouble(reading, self._w.air_c))
            await self._rest(self._w.period_s if self.beam else AIR_PERIOD_S)

    async def named(self, error: BaseException) -> BaseException:
        """Return the cause of a device error: the interlock that is tripped now or, if there is none, the error itself."""
        if not isinstance(error, DriverError | MeasurementFault) or isinstance(error, Rebooted):
            return error
        try:
            async with asyncio.timeout(self._w.unknown_s):
                found = tripped(await self._s.controller.status(), self.tolerated)
                laser = self._s.laser
                if found is None and laser is not None and isinstance(error, DriverError) and error.device == getattr(laser, "name", None):
                    found = beam_trouble(await laser.peek())
        except (DriverError, TimeoutError):
            return error
        return error if found is None else found

    def _raise(self, trouble: Interlock | None) -> None:
        if trouble is not None and trouble.condition not in self.tolerated:
            raise trouble

    async def _rest(self, seconds: float) -> None:
        try:
            async with asyncio.timeout(seconds):
                await self._ended.wait()
        except TimeoutError:
            return


@asynccontextmanager
async def watched(session: Session, control: Control, watching: Watching) -> AsyncIterator[Watch]:
    """Cancel this block as soon as a watcher fails or a person aborts; code inside stops its axes when it is cancelled.

    Raises
    ------
    Interlock, Aborted, DriverError
        The cause that ended the block.
    """
    watch, me = Watch(session, watching), asyncio.current_task()
    assert me is not None
    before = me.cancelling()
    beside = Beside(me)
    aborting = beside.start(control.aborted())
    beside.start(watch.controller())
    if session.laser is not None:
        beside.start(watch.laser(session.laser))
    body: BaseException | None = None
    try:
        yield watch
    except BaseException as error:  # noqa: BLE001 - raised again below as its cause
        body = error
    watch.end()
    aborting.cancel()
    await beside.ended()
    if me.cancelling() > before:  # an outside cancellation takes precedence over everything else
        raise body if isinstance(body, asyncio.CancelledError) else asyncio.CancelledError
    if body is not None and not isinstance(body, asyncio.CancelledError):
        raise await watch.named(body) from body
    if beside.errors:
        raise beside.errors[0] from None  # report one cause; the others follow from it
    if body is not None:
        raise body


class Beside:
    """Runs tasks beside a block of code; their first failure cancels the block.

    Unlike a TaskGroup it tells its own cancellation from one that comes from outside. Both may come while the axes are being stopped.
    """

    def __init__(self, block: asyncio.Task[Any]) -> None:
        self._block, self._open, self._cancelled = block, True, False
        self._tasks: set[asyncio.Task[None]] = set()
        self.errors: list[BaseException] = []

    def start(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Start a task beside the block."""
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._done)
        return task

    def _done(self, task: asyncio.Task[None]) -> None:
        if task.cancelled() or (error := task.exception()) is None:
            return
        self.errors.append(error)
        if self._open and not self._cancelled:
            self._cancelled = True
            self._block.cancel()

    async def ended(self) -> None:
        """End the watch after the block: take back the cancellation that a failed task caused, and wait for the tasks."""
        self._open = False
        if self._cancelled:
            self._block.uncancel()
        until_s = asyncio.get_running_loop().time() + END_S
        while pending := {task for task in self._tasks if not task.done()}:
            try:
                await asyncio.wait(pending, timeout=END_S)
            except asyncio.CancelledError:
                until_s = 0.0  # the task itself keeps the cancellation; after a second one do not wait for the poll
            if asyncio.get_running_loop().time() >= until_s:
                for task in pending:
                    task.cancel()
                until_s = math.inf
        await asyncio.sleep(0)  # their callbacks


async def known_status(ask: Callable[[], Awaitable[ControllerStatus]], unknown_s: float) -> ControllerStatus:
    """Read one status; retry lost replies until the status has been unknown for ``unknown_s``.

    Raises
    ------
    StatusUnknown
        No reply within ``unknown_s``. If this computer itself stalled in that time, the wait is extended once by another ``unknown_s``.
    Rebooted
        The controller restarted.
    """
    clock = asyncio.get_running_loop().time
    until_s = clock() + unknown_s
    why, again = "no answer", True
    with Stalls() as stalls:
        while True:
            try:
                async with asyncio.timeout_at(until_s):
                    return await ask()
            except Rebooted:
                raise
            except (DriverError, TimeoutError) as error:
                if isinstance(error, DriverError):
                    why = str(error)
            late_s = clock() - until_s
            if late_s < 0.0:
                await asyncio.sleep(min(RETRY_S, -late_s))
            elif again and max(late_s, stalls.longest_s) > LATE_S:
                until_s, again = clock() + unknown_s, False
            else:
                raise StatusUnknown(
                    f"the controller's status has been unknown for {1e3 * unknown_s:.0f} ms: {why}",
                    "look at the controller's link; nothing moves until its status is known",
                )


class Stalls:
    """Measures stalls of this computer while it is open. ``longest_s``: longest time, s, for which the event loop did
    not run, found by a timer that is due every `LOOK_S`."""

    def __init__(self) -> None:
        self.longest_s = 0.0
        self._loop = asyncio.get_running_loop()

    def __enter__(self) -> Self:
        self._look_again()
        return self

    def __exit__(self, *_: object) -> None:
        self._look.cancel()

    def _look_again(self) -> None:
        self._look = self._loop.call_at(self._loop.time() + LOOK_S, self._looked, self._loop.time() + LOOK_S)

    def _looked(self, due_s: float) -> None:
        self.longest_s = max(self.longest_s, self._loop.time() - due_s)
        self._look_again()


def first_of(error: BaseException) -> BaseException:
    """Return the first leaf error of an exception group."""
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    return error


LINKS = {"controller": "controller", "laser": "laser", "ballbar": "ball-bar"}
STILL_OPEN = "open"
"""Outcome of an incident that lasts beyond the end of the measurement."""
MOST_WAITING = 1000
"""Longest queue of lines while the database is locked; further incidents are only counted."""
LAST_LINES_S = 5.0
"""Longest wait at the end of a measurement for the last lines to reach the database."""


def links_of(session: Session) -> dict[str, Incidents]:
    """Return the incident lists of a session's links by device name; devices without a link are left out."""
    found = {name: getattr(getattr(session, attribute, None), "incidents", None) for attribute, name in LINKS.items()}
    return {name: one for name, one in found.items() if isinstance(one, Incidents)}


@contextmanager
def run_named(session: Session, name: str) -> Iterator[None]:
    """Attach the run's name to every error and incident in this block, also those outside our requests (heartbeat, pulled cable)."""
    links = links_of(session)
    for one in links.values():
        one.run = name
    try:
        with on_behalf_of(name):
            yield
    finally:
        for one in links.values():
            one.run = NO_RUN


@asynccontextmanager
async def incidents_noted(session: Session, notes: IncidentNotes) -> AsyncIterator[None]:
    """Write every incident of a session's links into the journal while the block lasts.

    The exit waits at most ``LAST_LINES_S`` for the last lines: a locked database must not keep a measurement from ending.
    """
    with ExitStack() as undo:
        links = links_of(session)
        for name, one in links.items():
            before, one.listen = one.listen, partial(notes.hear, name)
            undo.callback(setattr, one, "listen", before)
            if one.open is not None and one.entries:  # it began before the measurement and is still open
                notes.hear(name, one.entries[-1])
        writer = asyncio.create_task(notes.write())
        try:
            yield
        finally:
            undo.close()
            notes.still_open({name for name, one in links.items() if one.open is not None})
            await run_to_end(notes.finish(writer))


class IncidentNotes:
    """A queue of incidents and the task that empties it.

    ``not_written`` counts incidents missing from the journal: the queue was full, or the database took none until the end.
    """

    def __init__(self, journal: Journal, clock: Clock) -> None:
        self.not_written = 0
        self._journal, self._clock = journal, clock
        self._waiting: deque[dict[str, Any]] = deque()
        self._latest: dict[str, dict[str, Any]] = {}
        self._news, self._empty = asyncio.Event(), asyncio.Event()
        self._empty.set()

    def hear(self, link: str, entry: Incident) -> None:
        """Queue an incident; returns at once. Call it in the event loop."""
        at = self._clock.utc() - timedelta(seconds=max(time.monotonic() - entry.host_s, 0.0))
        line: dict[str, Any] = {
            "phase": entry.kind,
            "link": link,
            "code": entry.code,
            "device": entry.device,
            "run": entry.run,
            "text": entry.text,
        }
        line |= {"at_utc": at.isoformat(timespec="milliseconds"), "host_s": entry.host_s}
        line |= {"state": entry.state, "times": entry.times} if entry.kind == OUTCOME else {}
        self._put(link, line)

    def still_open(self, links: set[str]) -> None:
        """Record the outcome "open" for links whose incident lasts beyond the end of the measurement."""
        now = {"phase": OUTCOME, "state": STILL_OPEN, "at_utc": self._clock.utc().isoformat(timespec="milliseconds")}
        for link in sorted(links & self._latest.keys()):
            self._put(link, self._latest[link] | now | {"host_s": time.monotonic()})

    def _put(self, link: str, line: dict[str, Any]) -> None:
        self._latest[link] = line
        if len(self._waiting) >= MOST_WAITING:
            self.not_written += 1
            return
        self._waiting.append(line)
        self._empty.clear()
        self._news.set()

    async def write(self) -> None:
        """Write queued lines in order until cancelled. A line that the database refuses is counted and left out."""
        while True:
            await self._news.wait()
            self._news.clear()
            while self._waiting:
                try:
                    await self._journal.add(INCIDENT, **self._waiting[0])
                except Exception:  # noqa: BLE001 - a note about a link must not end a measurement
                    self.not_written += 1
                self._waiting.popleft()
            self._empty.set()

    async def finish(self, writer: asyncio.Task[None]) -> None:
        """Wait up to ``LAST_LINES_S`` for the last lines, then end the task."""
        with suppress(TimeoutError):
            async with asyncio.timeout(LAST_LINES_S):
                waited = asyncio.create_task(self._empty.wait())
                try:
                    await asyncio.wait({waited, writer}, return_when=asyncio.FIRST_COMPLETED)
                finally:
                    waited.cancel()
        self.not_written += len(self._waiting)
        writer.cancel()
        await asyncio.wait({writer})
