"""Paths: the ball-bar streams while the axes run a polyline; an error ends both.

Motion never outlives the block that commanded it (`motion_interlock`); if the stop fails, the error tells the person to press e-stop.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any, Protocol

from abbe.drivers.api import BarBatch, BarTap, Condition, ControllerStatus, Motion, Paths, bar_is_out, bar_is_valid, on_path
from abbe.drivers.errors import DriverError, run_to_end
from abbe.service.devices.session import Session
from abbe.service.errors import AbbeError, BarOutOfRange, MeasurementFault, RunInterrupted
from abbe.service.sequences.control import Control, check_interlocks
from abbe.service.sequences.resume_plan import PathProgress, PathRemainder, StretchComparison
from abbe.service.sequences.steps import FollowPath, RecordPath
from abbe.service.sequences.watch import first_of


class Recorder(Protocol):
    """Receives and stores the data of one run."""

    def tap(self) -> BarTap:
        """Return the receiver of every sample of a new stream."""
        ...

    async def add_bar(self, batch: BarBatch) -> None:
        """Account for a batch that the tap received; raises if its samples are not safe, so that the motion stops."""
        ...

    async def flush(self) -> None:
        """Wait until all data received so far are on the disk."""
        ...

    async def add_record(self, record: dict[str, Any]) -> None:
        """Store one record of the laser, or of another instrument with single readings."""
        ...


STOP_S = 10.0
"""Longest time for a stop, s. The driver gives up earlier: it waits a few seconds for each write, and 5 s until the axes stand."""
Spare = Callable[[], Awaitable[bool]]
UNDELIVERED = "the stop could not be delivered: press e-stop"


@asynccontextmanager
async def motion_interlock(controller: Motion, spare: Spare | None = None) -> AsyncIterator[None]:
    """Stop the axes when an error or a cancellation ends this block. If the stop fails, the error gets a warning.

    ``spare`` returns whether another program controls the machine and nothing of ours can move: then no stop is sent.
    """
    try:
        yield
    except BaseException as error:
        stopped = asyncio.Event()
        try:
            await run_to_end(_stop(controller, stopped, spare))
        except asyncio.CancelledError as cancelled:
            if stopped.is_set():
                raise
            raise with_warning(cancelled) from error
        if stopped.is_set():
            raise
        warned = with_warning(error)
        if warned is error:
            raise
        raise warned from error


async def _stop(controller: Motion, stopped: asyncio.Event, spare: Spare | None) -> None:
    try:
        async with asyncio.timeout(STOP_S):
            if spare is None or not await spare():
                await controller.abort()
    except Exception:  # noqa: BLE001 - whatever the cause, the axes may run on: the caller warns of that
        return
    stopped.set()


def with_warning(error: BaseException) -> BaseException:
    """Add the warning that the axes may still move: in the detail of an error of Abbe, as a note (PEP 678) on any other error."""
    if isinstance(error, AbbeError | DriverError):
        if UNDELIVERED in error.detail:
            return error
        detail = f"{error.detail}; {UNDELIVERED}"
        if isinstance(error, DriverError):
            return type(error)(error.device, error.operation, detail, error.remedy)
        return type(error)(detail, error.remedy)
    if UNDELIVERED not in warnings_of(error):
        error.add_note(UNDELIVERED)
    return error


def warnings_of(error: BaseException) -> list[str]:
    """Return the notes of an exception (PEP 678)."""
    return list(getattr(error, "__notes__", []))


POLL_S = 0.01
STALL_S = 10.0
STAND_S = 5.0
BAD_IN_A_ROW = 25
OUT_S = 0.03
"""Time for which the bar may be out of range, s: long enough for one or two disturbed samples, short enough to stop in time."""


def bar_trouble(status: int) -> BarOutOfRange:
    """Return the error of a ball-bar that reports no valid reading."""
    return BarOutOfRange(
        f"the ball-bar is out of range or not mounted (status {status:#06x})",
        "check centre, radius and that the bar sits in both cups, then start the test again",
    )


async def record_path(
    session: Session, step: RecordPath, recorder: Recorder, control: Control, way: PathProgress, remainder: PathRemainder | None = None
) -> dict[str, int]:
    """Run a path while the ball-bar streams; return its start and end in controller time (us).

    Updates ``way`` with the progress; for the rest of an interrupted path, ``remainder`` holds earlier readings that the bar must repeat.

    Raises
    ------
    BarOutOfRange, MeasurementFault, RunInterrupted, StretchDiffers, DriverError
        The axes stop before the error is raised.
    """
    controller = session.controller
    await controller.load_path(step.points_mm)
    stretch = None if remainder is None else StretchComparison(remainder, step.rate_hz)
    pump = Pump(recorder, step.rate_hz, way, stretch)
    # The guard stands inside the stream: closing the stream of a silent box takes seconds, and the axes must stop before that.
    async with session.need_ballbar().stream(step.rate_hz, recorder.tap()) as batches, motion_interlock(controller):
        try:
            async with asyncio.TaskGroup() as group:
                pumping = group.create_task(pump.run(batches))
                await pump.reads.wait()  # the bar must read before anything moves
                await controller.start_path(feed_mm_min=step.feed_mm_min)
                status = await follow(controller, control, way)
                pump.finished.set()
                await asyncio.wait({pumping})  # here, not at the group's exit: there an outside cancellation could get lost
        except BaseExceptionGroup as errors:
            raise first_of(errors) from None  # report one cause; the others follow from it
    found = {"path_start_us": status.path_start_us, "path_end_us": status.path_end_us}
    return found if stretch is None or stretch.off_mm is None else found | {"stretch_off_nm": round(stretch.off_mm * 1e6)}


async def follow_path(controller: Paths, step: FollowPath, control: Control) -> None:
    """Run a path without recording."""
    await controller.load_path(step.points_mm)
    async with motion_interlock(controller):
        await controller.start_path(feed_mm_min=step.feed_mm_min)
        await follow(controller, control)


async def follow(controller: Motion, control: Control, way: PathProgress | None = None) -> ControllerStatus:
    """Poll until the path has ended; an interlock, a feed hold, a stall or a person ends the run."""
    loop = asyncio.get_running_loop()
    points, since = -1, loop.time()
    while True:
        status = await controller.status()
        check_interlocks(status)
        if Condition.FEED_HOLD in status.conditions:
            raise MeasurementFault(
                "feed hold was pressed while the ball-bar recorded", "start the test again: readings must be at constant feed"
            )
        if not status.path_running and status.path_end_us > status.path_start_us:
            return status
        if way is not None and status.path_running:
            way.add(status)
        if control.pausing or control.stopping:
            await feed_hold(controller)
            control.check()
            raise RunInterrupted("paused on the path: its readings are kept as evidence", "the path is measured again after the pause")
        if status.path_points_done != points:
            points, since = status.path_points_done, loop.time()
        elif loop.time() - since > STALL_S:
            raise MeasurementFault(f"the path has not advanced for {STALL_S:g} s", "look at the machine: is the feed override at zero?")
        await asyncio.sleep(POLL_S)


async def feed_hold(controller: Motion) -> None:
    """Apply feed hold and wait until the axes stand: a feed hold lets a real machine brake along its path; an abort need not."""
    await controller.hold()
    until_s, last = asyncio.get_running_loop().time() + STAND_S, None
    while asyncio.get_running_loop().time() < until_s:
        status = await controller.status()
        if status.position_mm == last or not status.moving:
            return
        last = status.position_mm
        await asyncio.sleep(POLL_S)


class Pump:
    """Passes samples to the recorder until the path has ended and a batch ends with a sample taken after the path (sync level low)."""

    def __init__(self, recorder: Recorder, rate_hz: int, way: PathProgress | None = None, stretch: StretchComparison | None = None) -> None:
        self._recorder = recorder
        self._way, self._stretch = way, stretch
        self._bad = self._out = 0
        self._out_limit = max(2, round(OUT_S * rate_hz))
        self.reads = asyncio.Event()
        self.finished = asyncio.Event()

    async def run(self, batches: AsyncIterator[BarBatch]) -> None:
        """Record; set `reads` at the first valid reading.

        Raises
        ------
        BarOutOfRange, MeasurementFault
            The bar is out of range, or samples are lost.
        StretchDiffers
            The stretch that is read twice gives other readings than before the interruption.
        """
        async for batch in batches:
            await self._recorder.add_bar(batch)
            if self._way is not None:
                self._way.boot_id = batch.boot_id
            if self._stretch is not None:
                self._stretch.from_box(batch.boot_id)
            for sample in batch.samples:
                self._look(sample.status)
                if self._stretch is not None:
                    self._stretch.add(sample)
            if self.finished.is_set() and batch.samples and not on_path(batch.samples[-1].status):
                if self._stretch is not None:
                    self._stretch.judge()
                return

    def _look(self, status: int) -> None:
        counts = on_path(status) or not self.reads.is_set()
        self._out = self._out + 1 if counts and bar_is_out(status) else 0
        self._bad = self._bad + 1 if counts and not bar_is_valid(status) else 0
        if self._out >= self._out_limit:
            raise bar_trouble(status)
        if self._bad >= BAD_IN_A_ROW:
            raise MeasurementFault(f"the ball-bar's box loses samples (status {status:#06x})", "lower the rate, look at its cable")
        if not bar_is_out(status):
            self.reads.set()
