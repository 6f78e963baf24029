"""The watcher beside a running test: polls controller and laser, and ends the test at an interlock or when one does not answer.

The latency from an event to the end of the motion command stream is one period, one exchange, and the stop. The controller's link carries
one request at a time, so the watcher waits its turn and never has more than one request pending. While other tasks poll more often (along a
path), the watcher uses their answers, and asks only when the latest is a period old.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine
from contextlib import asynccontextmanager
from typing import Any

from abbe.drivers.api import ControllerStatus, DisplacementMeter
from abbe.drivers.errors import DriverError, Rebooted
from abbe.service.devices.session import Session, latest_status
from abbe.service.errors import Interlock, MeasurementFault, StatusUnknown
from abbe.service.sequences.control import Control
from abbe.service.sequences.interlocks import Watching, air_trouble, beam_trouble, tripped

AIR_PERIOD_S = 1.0
LASER_UNKNOWN_S = 2.5
"""Longest silence of the laser: on a serial line one lost reply costs a second, and only a reading depends on it."""
RETRY_S = 0.02
LATE_S = 0.1
"""A later wake-up means that this computer stalled: the watcher asks once more before it calls the status unknown."""
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
        """Status that another task read less than a period ago, or None."""
        status = latest_status(self._s.controller)
        if status is None or status.host_s <= max(self._since_s, time.monotonic() - self._w.period_s):
            return None
        return status

    async def laser(self, laser: DisplacementMeter) -> None:
        """Poll the laser until the test ends: its beam while that matters, the air always.

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
        """Return the cause of a device error: the interlock if one holds, else the error itself."""
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
    """Tasks beside a block; their first failure cancels the block. Unlike a TaskGroup it never takes an outside cancellation for its own:
    both may come while the axes are being stopped."""

    def __init__(self, block: asyncio.Task[Any]) -> None:
        self._block, self._open, self._cancelled = block, True, False
        self._tasks: set[asyncio.Task[None]] = set()
        self.errors: list[BaseException] = []

    def start(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Start a task."""
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
        """Withdraw our own cancellation after the block, and wait for the tasks."""
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
        No reply within ``unknown_s``. A stall of this computer does not count against the controller.
    Rebooted
        The controller restarted.
    """
    clock = asyncio.get_running_loop().time
    until_s = clock() + unknown_s
    why, again = "no answer", True
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
        if late_s > LATE_S and again:
            until_s, again = clock() + unknown_s, False
        elif late_s >= 0.0:
            raise StatusUnknown(
                f"the controller's status is unknown for {1e3 * unknown_s:.0f} ms: {why}",
                "look at its link; nothing moves until it is known",
            )
        else:
            await asyncio.sleep(min(RETRY_S, -late_s))


def first_of(error: BaseException) -> BaseException:
    """First leaf error of an exception group."""
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    return error
