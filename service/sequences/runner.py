"""Interprets the steps of one test on real devices. Motion never outlives the block that commanded it."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Callable

from drivers.api import BarBatch, Controller, ControllerStatus, Point
from service.devices.session import Session
from service.errors import MeasurementFault, UnsafeToMove
from service.runs.recorder import Recorder
from service.sequences.check import step_seconds
from service.sequences.guard import motion_guard
from service.sequences.steps import (
    ChangeBar,
    MountBar,
    MountLaser,
    MoveTo,
    ReadLaser,
    RecordPath,
    Step,
    TakeBarOut,
    TestPlan,
    Unmount,
    ZeroLaser,
)

ESTOP, DOOR, ALARM, REMOTE, REFERENCED, DRIVES, MOVING, HOLD, PATH, PROGRAM = 0, 1, 2, 3, 4, 5, 6, 8, 9, 11
FORBIDDEN = (
    (ESTOP, "e-stop is pressed"),
    (DOOR, "the door is open"),
    (ALARM, "the controller has an alarm"),
    (PROGRAM, "an NC program runs"),
)
NEEDED = ((REMOTE, "the controller is not in remote mode"), (REFERENCED, "the axes are not referenced"), (DRIVES, "the drives are off"))
POLL_S = 0.01
STALL_S = 10.0
BAD_IN_A_ROW = 25
SYNC, BAD_BITS = 0b1000, 0b10101
COMPENSATED = 3

BY_HAND = MountBar | TakeBarOut | ChangeBar | MountLaser | Unmount
Tick = Callable[[float, float], None]
"""Called after each step: planned machine seconds done so far in the test, and wall seconds that this step waited for a person."""


def check_interlocks(status: ControllerStatus) -> None:
    """Refuse to move (or to go on) unless the controller says that it is safe.

    Raises
    ------
    UnsafeToMove
        Which condition, and that nothing moves until it is cleared.
    """
    for bit, text in FORBIDDEN:
        if status.bits >> bit & 1:
            raise UnsafeToMove(text, "clear it at the machine, then start again; the run so far is kept as incomplete")
    for bit, text in NEEDED:
        if not status.bits >> bit & 1:
            raise UnsafeToMove(text, "make the machine ready, then start again")


class Runner:
    """Runs tests on one session."""

    def __init__(self, session: Session) -> None:
        self._s = session

    async def run(self, plan: TestPlan, recorder: Recorder, tick: Tick) -> dict[str, int]:
        """Execute a test; returns what the end document needs, in controller time.

        ``mounted_us``: when a cup or a laser was mounted, if this test mounts one; ``path_start_us``, ``path_end_us``: of a ball-bar run.

        Raises
        ------
        UnsafeToMove, MeasurementFault, DriverError
            The axes are stopped before the error leaves.
        """
        result: dict[str, int] = {}
        here: Point | None = None
        done, clock = 0.0, asyncio.get_running_loop().time
        async with motion_guard(self._s.controller):
            check_interlocks(await self._s.controller.status())
            for step in plan.steps:
                if isinstance(step, MoveTo) and here == step.target_mm:
                    continue
                seconds, after = step_seconds(step, here)
                began = clock()
                result |= await self._step(step, here, recorder)
                done, here = done + seconds, after
                tick(done, clock() - began if isinstance(step, BY_HAND) else 0.0)
        return result

    async def _step(self, step: Step, here: Point | None, recorder: Recorder) -> dict[str, int]:
        match step:
            case MoveTo(target, feed):
                await self._move(target, feed, here)
            case MountBar(radius):
                await self._s.need_fixture().mount_ballbar(radius)
                return await self._mounted()
            case TakeBarOut():
                await self._s.need_fixture().take_out_ballbar()
            case ChangeBar(radius):
                await self._s.need_fixture().change_ballbar(radius)
            case MountLaser(beam):
                await self._s.need_fixture().mount_laser(beam)
                return await self._mounted()
            case Unmount():
                await self._s.need_fixture().unmount()
            case ZeroLaser():
                laser = self._s.need_laser()
                await laser.clear_beam()
                await laser.set_environment_compensation(True)  # without it every length is 270 ppm too long
                await laser.zero()
            case ReadLaser(direction, settle_s):
                await self._read_laser(direction, settle_s, recorder, here)
            case RecordPath():
                return await self._record_path(step, recorder)
        return {}

    async def _mounted(self) -> dict[str, int]:
        """Whoever mounts takes minutes: the clock is asked when it is done, not when the test began."""
        return {"mounted_us": (await self._s.controller.status()).ctrl_us}

    async def _move(self, target: Point, feed_mm_min: float, here: Point | None) -> None:
        seconds = 60.0 if here is None else math.dist(here, target) / feed_mm_min * 60.0
        status = await self._s.controller.move(target, feed_mm_min=feed_mm_min, timeout_s=30.0 + 3.0 * seconds)
        check_interlocks(status)

    async def _read_laser(self, direction: int, settle_s: float, recorder: Recorder, here: Point | None) -> None:
        status = await self._s.controller.status()
        while status.ctrl_us < status.in_position_us + settle_s * 1e6:
            await asyncio.sleep(0.001)
            status = await self._s.controller.status()
        check_interlocks(status)
        laser = self._s.need_laser()
        before = await laser.read()
        reading = await laser.read(after_count=before.sample_count)  # a sample that began after the axes had settled
        if not reading.status >> COMPENSATED & 1:
            raise MeasurementFault("the laser's environmental compensation was switched off during the run", "start the test again")
        await recorder.add_record(
            {
                "host_s": reading.host_s,
                "ctrl_us": status.ctrl_us,
                "target_mm": list(here if here is not None else status.position_mm),
                "direction": direction,
                "displacement_tenth_nm": reading.displacement_tenth_nm,
                "status": reading.status,
                "signal_permille": reading.signal_permille,
                "air_temp_c": reading.air_temp_c,
                "air_pressure_pa": reading.air_pressure_pa,
                "feed_mm_min": 0.0,
            }
        )

    async def _record_path(self, step: RecordPath, recorder: Recorder) -> dict[str, int]:
        controller = self._s.controller
        await controller.load_path(step.points_mm)
        finished = asyncio.Event()
        # The guard stands inside the stream: closing the stream of a mute box takes seconds, and the axes must not run on so long.
        async with self._s.need_ballbar().stream(step.rate_hz) as batches, motion_guard(controller):
            try:
                async with asyncio.TaskGroup() as group:
                    group.create_task(_pump(batches, recorder, finished))
                    await controller.start_path(feed_mm_min=step.feed_mm_min)
                    status = await _watch(controller)
                    finished.set()
            except BaseExceptionGroup as errors:
                raise _first(errors) from None  # one cause for one person; the others follow from it
        return {"path_start_us": status.path_start_us, "path_end_us": status.path_end_us}


def _first(error: BaseException) -> BaseException:
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    return error


async def _watch(controller: Controller) -> ControllerStatus:
    """Poll until the path has ended; an interlock, a feed hold or a stall ends the run."""
    loop = asyncio.get_running_loop()
    points, since = -1, loop.time()
    while True:
        status = await controller.status()
        check_interlocks(status)
        if status.bits >> HOLD & 1:
            raise MeasurementFault(
                "feed hold was pressed while the ball-bar recorded", "start the test again: readings must be at constant feed"
            )
        if not status.bits >> PATH & 1 and status.path_end_us > status.path_start_us:
            return status
        if status.path_points_done != points:
            points, since = status.path_points_done, loop.time()
        elif loop.time() - since > STALL_S:
            raise MeasurementFault(f"the path has not advanced for {STALL_S:g} s", "look at the machine: is the feed override at zero?")
        await asyncio.sleep(POLL_S)


async def _pump(batches: AsyncIterator[BarBatch], recorder: Recorder, finished: asyncio.Event) -> None:
    """Record until the path has ended and one sample without the sync level has been seen."""
    bad = 0
    async for batch in batches:
        await recorder.add_bar(batch)
        for sample in batch.samples:
            on_path = bool(sample.status & SYNC)
            bad = bad + 1 if on_path and sample.status & BAD_BITS else 0
            if bad >= BAD_IN_A_ROW:
                raise MeasurementFault(
                    f"the ball-bar is out of range or not mounted (status {sample.status:#06x})",
                    "check centre, radius and that the bar sits in both cups, then start the test again",
                )
        if finished.is_set() and batch.samples and not batch.samples[-1].status & SYNC:
            return
