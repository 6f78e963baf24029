"""Interprets the steps of one test on real devices. All motion ends with the block of code that commanded it."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable
from typing import Any

from abbe.drivers.api import BallBar, BarSample, ControllerStatus, Point, air_doc, air_is_compensated, bar_is_out, bar_is_valid
from abbe.drivers.errors import Refused
from abbe.service.devices.session import Session
from abbe.service.domain.document import parsed
from abbe.service.domain.measured import LaserRecord, TouchRecord
from abbe.service.errors import BeamLost, MeasurementFault, RunInterrupted, SetupDisturbed
from abbe.service.sequences.check import step_seconds
from abbe.service.sequences.control import AT_WORK, PAUSED, Control, ExpectedTable, Watching, check_interlocks, check_ours
from abbe.service.sequences.journal import HAND, POINT, Journal, NoJournal
from abbe.service.sequences.paths import Recorder, bar_trouble, follow_path, motion_interlock, record_path
from abbe.service.sequences.probing import FeatureTouch, check_same, guarded_move, need_probe
from abbe.service.sequences.resume_plan import BY_HAND, OFF_PATH_MM, REFERENCE_MM, Attempt, PathProgress, PathRemainder, way_back
from abbe.service.sequences.steps import (
    ChangeBar,
    FollowPath,
    MountArtefact,
    MountBar,
    MountLaser,
    MoveTo,
    ReadBar,
    ReadLaser,
    RecordPath,
    Step,
    TakeBarOut,
    TestPlan,
    TouchFeature,
    Unmount,
    ZeroLaser,
    references_of,
)
from abbe.service.sequences.waiting import paused
from abbe.service.sequences.watch import NOTHING, Watch, watched

# A ball-bar reading at standstill: the mean of a few samples that the box began after the axes had settled.


async def read_bar(ballbar: BallBar, step: ReadBar, status: ControllerStatus, here: Point | None) -> dict[str, Any]:
    """Return one record of a point-by-point test, with every sample of its mean.

    The stream starts after ``status`` showed settled axes, so no sample is older than that, whatever the arrival times.

    Raises
    ------
    BarOutOfRange, MeasurementFault
        The box flags a sample as out of range or taken without a bar, or samples are lost.
    """
    samples: list[BarSample] = []
    host_s = status.host_s
    async with ballbar.stream(step.rate_hz) as batches:
        async for batch in batches:
            host_s = batch.host_s
            samples += batch.samples
            if len(samples) >= step.samples:
                break
    taken = samples[: step.samples]
    bad = [s for s in taken if not bar_is_valid(s.status)]
    if bad or len(taken) < step.samples:
        if bad and bar_is_out(bad[0].status):
            raise bar_trouble(bad[0].status)
        what = f"status {bad[0].status:#06x}" if bad else f"{len(taken)} of {step.samples} samples came"
        raise MeasurementFault(f"the ball-bar's box loses samples ({what})", "look at its cable, then start the test again")
    return {
        "host_s": host_s,
        "ctrl_us": status.ctrl_us,
        "target_mm": list(here if here is not None else status.position_mm),
        "direction": step.direction,
        "feed_mm_min": 0.0,
        "device_us": [s.device_us for s in taken],
        "reading_nm": [s.reading_nm for s in taken],
        "status": [s.status for s in taken],
    }


SAME_PLACE_MM = 1e-3
MM_PER_COUNT = 1e-7
BY_MOVES = 12
"""Largest number of points of a way back that is driven in single moves; a longer one runs as a path."""

Tick = Callable[[float, float], None]
"""Called after each step with the planned machine seconds done so far in the test, and the wall seconds this step waited for a person."""


class Runner:
    """Runs tests on one session. ``expected``: start of the controller and table in force, which must be the same after a pause."""

    def __init__(
        self,
        session: Session,
        control: Control | None = None,
        watching: Watching | None = None,
        journal: Journal | None = None,
        expected: ExpectedTable | None = None,
    ) -> None:
        self._s = session
        self._control = control or Control()
        self._watching = watching or Watching()
        self.journal = journal or NoJournal()
        self._expected = expected
        self._waited_s = 0.0
        self._points = 0
        self._still = self._stands = self._paused_here = False
        self._references: tuple[TouchFeature, ...] = ()
        """Qualification sphere and first feature of a pose: touched again, they show whether stylus and artefact have changed."""
        self.touched = False
        """Whether a person may have touched the set-up in the pause that ended the run."""
        self.hand: int | None = None
        """Number of the last manual step that was done; ``asked``: number of the step that was requested and is not yet done."""
        self.asked: int | None = None
        self.mounted_us: int | None = None
        self.gained = False
        """Whether this attempt read a new point; for paths only the store knows."""
        self.way: PathProgress | None = None
        """Progress of the recorded path."""
        self._remainder: PathRemainder | None = None
        self.records: list[dict[str, Any]] = []
        """Laser records since the zero, or touched features since the mounting: a resumed run can begin with them."""

    async def run(self, plan: TestPlan, recorder: Recorder, tick: Tick, attempt: Attempt | None = None) -> dict[str, int]:
        """Execute a test, or the rest of it; return the controller times (us) for the end document.

        ``mounted_us``: mounting of a cup or a laser, if this test mounts one; ``path_start_us``, ``path_end_us``: start and end of a
        ball-bar's path.

        Raises
        ------
        Interlock, Stopped, Aborted, RunInterrupted, SetupDisturbed, MeasurementFault, DriverError
            The axes stop before the error is raised.
        """
        attempt = attempt or Attempt()
        self._remainder = attempt.remainder
        result: dict[str, int] = {}
        done, clock = 0.0, asyncio.get_running_loop().time
        # The guard is outermost: its warning of a failed stop must not be lost among the watcher's errors.
        check_ours(await self._s.controller.status())  # before the guard, whose stop would end another program
        self._stands = not plan.mounts
        async with motion_interlock(self._s.controller, self._spared), watched(self._s, self._control, self._watching) as watch:
            check_interlocks(await self._s.controller.status())
            here = await self._gone_back(attempt, recorder, watch)
            for k, step in enumerate(plan.steps):
                if isinstance(step, MoveTo) and here == step.target_mm:
                    continue
                self._control.place(k + 1, len(plan.steps), self._points)
                await self._safe_place(step, watch)
                await self._check_door_closed(step, watch)
                seconds, after = step_seconds(step, here)
                began = clock()
                if isinstance(step, BY_HAND):
                    result |= await self._by_hand(step, k, attempt, watch)
                    self._waited_s += clock() - began
                else:
                    result |= await self._step(step, here, recorder, watch)
                await self._reached(step, k, attempt, recorder, watch)
                done, here = done + seconds, after
                waited, self._waited_s = self._waited_s, 0.0
                tick(done, waited)
        return result

    # ---- checkpoints ----------------------------------------------------------------------------------------------

    async def _safe_place(self, step: Step, watch: Watch) -> None:
        """Pause or end here if requested, before a motion or manual work. Pending readings are taken first."""
        if isinstance(step, ReadLaser | ReadBar | ZeroLaser):
            return
        self._control.check()
        if self._control.pausing:
            await self._paused(watch)

    async def _paused(self, watch: Watch) -> None:
        before_mm = (await self._s.controller.status()).position_mm
        watch.tolerated, self._still = PAUSED, True
        touched = await paused(self._s, self._control, self._watching, self._expected, self.journal, beam=watch.beam)
        watch.tolerated, self._still, self._paused_here = NOTHING, False, True
        if touched and self._stands:
            self.touched = True
            raise RunInterrupted("the door was open during the pause", "Abbe asks about the set-up before it resumes the test")
        status = await self._s.controller.status()
        if math.dist(status.position_mm, before_mm) > SAME_PLACE_MM:
            raise RunInterrupted("the axes were moved during the pause", "Abbe resumes the test from its last checkpoint")

    async def _spared(self) -> bool:
        """Return whether nothing of ours can move and another program controls the machine: a stop would end that program."""
        if not self._still:
            return False
        status = await self._s.controller.status()
        return status.program_runs or not status.remote

    async def _check_door_closed(self, step: Step, watch: Watch) -> None:
        """End the test if the door is not closed at the first motion after manual work."""
        if watch.tolerated and not isinstance(step, BY_HAND):
            check_interlocks(await self._s.controller.status())
            watch.tolerated = NOTHING

    async def _reached(self, step: Step, k: int, attempt: Attempt, recorder: Recorder, watch: Watch) -> None:
        if isinstance(step, Unmount):
            watch.beam = False
        if isinstance(step, ReadLaser):
            watch.beam = True
        if isinstance(step, ReadLaser | ReadBar | TouchFeature):
            self._points, self.gained = self._points + 1, True
            if attempt.run_id:
                await self.journal.add(POINT, test=attempt.test, run=attempt.run_id, step=attempt.offset + k, points=self._points)

    async def _by_hand(self, step: Step, k: int, attempt: Attempt, watch: Watch) -> dict[str, int]:
        """Have a person do a manual step: the door may be open, and nothing moves until it is closed."""
        line = {"test": attempt.test, "setup": attempt.setup, "mounting": attempt.mounting, "step": attempt.offset + k}
        line |= {"what": type(step).__name__}
        watch.beam = False
        watch.tolerated = AT_WORK
        self.asked, self.records = attempt.offset + k, []
        await self.journal.add(HAND, phase="asked", **line)
        self._still = True
        await self._control.unless_stopped(self._done_by_hand(step))
        self._still, self._stands = False, not isinstance(step, Unmount)
        status = await self._s.controller.status()  # mounting takes minutes: read the clock afterwards
        await self.journal.add(HAND, phase="done", ctrl_us=status.ctrl_us, **line)
        self.hand, self.asked = attempt.offset + k, None
        if not isinstance(step, MountBar | MountLaser | MountArtefact):
            return {}
        self.mounted_us = status.ctrl_us
        return {"mounted_us": status.ctrl_us}

    # ---- resuming --------------------------------------------------------------------------------------------------

    async def _gone_back(self, attempt: Attempt, recorder: Recorder, watch: Watch) -> Point | None:
        """Return to the last checkpoint along the way that the test came; return the new position, or None if nothing is mounted."""
        resume_trail = attempt.resume_trail
        self.records = list(resume_trail.carried)  # what fails on the way must not lose them
        if resume_trail.again:
            return await self._same_artefact(resume_trail.again, resume_trail.carried, recorder, watch)
        if not resume_trail.trail:
            return None
        status = await self._s.controller.status()
        watch.beam = bool(resume_trail.carried)
        points = way_back(resume_trail, status.position_mm)
        if len(points) <= BY_MOVES:
            for point in points:
                await self._safe_place(MoveTo(point, resume_trail.feed_mm_min), watch)
                await self._move(point, resume_trail.feed_mm_min, None)
        else:
            await follow_path(self._s.controller, FollowPath(points, resume_trail.feed_mm_min), self._control)
        for point in resume_trail.trail[resume_trail.to + 1 : resume_trail.upto + 1]:
            await self._safe_place(MoveTo(point, resume_trail.feed_mm_min), watch)
            await self._move(point, resume_trail.feed_mm_min, None)
        if resume_trail.carried:
            await self._same_as(resume_trail.carried[-1], recorder, resume_trail.carried)
        return resume_trail.trail[resume_trail.upto]

    async def _same_as(self, last: dict[str, Any], recorder: Recorder, carried: tuple[dict[str, Any], ...]) -> None:
        """Read the last complete point again: only an equal reading proves an undisturbed set-up and an unbroken count."""
        status, before = await self._settled(0.3), parsed(LaserRecord, last)
        now = parsed(LaserRecord, await self._laser_record(status, before.target_mm, int(before.direction)))
        off_mm = abs(now.displacement_tenth_nm - before.displacement_tenth_nm) * MM_PER_COUNT
        if off_mm > REFERENCE_MM:
            raise SetupDisturbed(
                f"the last point reads {1e3 * off_mm:.1f} um off its value before the interruption (allowed: {1e3 * REFERENCE_MM:.0f} um)",
                "laser or mirror was displaced; mount the set-up again when Abbe asks for it",
            )
        for one in carried:
            await recorder.add_record(one)
        self._points = len(carried)

    async def _same_artefact(
        self, references: tuple[TouchFeature, ...], carried: tuple[dict[str, Any], ...], recorder: Recorder, watch: Watch
    ) -> Point:
        """Touch the references again: only equal results prove an undisturbed stylus and artefact. Then keep the earlier features."""
        self._references = references
        await self._requalified(watch)
        for one in carried:
            await recorder.add_record(one)
        self._points = len(carried)
        return references[-1].above_mm

    # ---- single steps -----------------------------------------------------------------------------------------------

    def _done_by_hand(self, step: Step) -> Awaitable[None]:
        fixture = self._s.need_fixture()
        match step:
            case MountBar(radius):
                return fixture.mount_ballbar(radius)
            case TakeBarOut():
                return fixture.take_out_ballbar()
            case ChangeBar(radius):
                return fixture.change_ballbar(radius)
            case MountLaser(beam):
                return fixture.mount_laser(beam)
            case MountArtefact(origin, matrix):
                return fixture.mount_artefact(origin, matrix)
        return fixture.unmount()

    async def _step(self, step: Step, here: Point | None, recorder: Recorder, watch: Watch) -> dict[str, int]:
        match step:
            case MoveTo(target, feed, guarded):
                await self._move(target, feed, here, guarded=guarded)
            case ZeroLaser():
                self.records = []
                await self._zeroed()
            case ReadLaser(direction, settle_s):
                status = await self._settled(settle_s)
                await self._kept(await self._laser_record(status, here, direction), recorder)
            case ReadBar():
                settled = await self._settled(step.settle_s)
                await recorder.add_record(await read_bar(self._s.need_ballbar(), step, settled, here))
            case TouchFeature():
                record = await self._touched(step, watch)
                check_same(parsed(TouchRecord, record), [parsed(TouchRecord, one) for one in self.records])
                self._references = references_of((*(self._references if self.records else ()), step))
                await self._kept(record, recorder)
            case FollowPath():
                await self._stands_at(step.points_mm[0])
                await follow_path(self._s.controller, step, self._control)
            case RecordPath():
                return await self._recorded(step, recorder)
        return {}

    async def _touched(self, step: TouchFeature, watch: Watch) -> dict[str, Any]:
        """Touch a feature. Its time is the end of the touches; its temperature is the air's, if there is a laser.

        In a pause a person may have touched stylus or artefact: then first touch the references, and this feature anew.
        """
        record = None
        while record is None:
            await self._safe_place(step, watch)
            paused_here, self._paused_here = self._paused_here, False
            if paused_here and self.records:
                await self._requalified(watch, but=step)
            record = await FeatureTouch(need_probe(self._s.controller), step, lambda: self._control.stopping or self._control.pausing).run()
        status = await self._s.controller.status()
        check_interlocks(status)
        air_c = None if self._s.laser is None else (await self._s.laser.peek()).air_temp_c
        known = {} if air_c is None or math.isnan(air_c) else {"temperature_C": air_c}
        return {"host_s": status.host_s, "ctrl_us": status.ctrl_us, **record, **known}

    async def _requalified(self, watch: Watch, but: TouchFeature | None = None) -> None:
        earlier = [parsed(TouchRecord, one) for one in self.records]
        for reference in (one for one in self._references if one != but):
            check_same(parsed(TouchRecord, await self._touched(reference, watch)), earlier)

    async def _stands_at(self, start_mm: Point) -> None:
        """Refuse a path unless the machine stands at its start: from elsewhere the first move may lead through the sphere."""
        off_mm = math.dist((await self._s.controller.status()).position_mm, start_mm)
        if off_mm > OFF_PATH_MM:
            raise MeasurementFault(f"the machine stands {off_mm:.3f} mm off the start of the path", "look at the machine, then begin again")

    async def _recorded(self, step: RecordPath, recorder: Recorder) -> dict[str, int]:
        await self._stands_at(step.points_mm[0])
        self.way = PathProgress(step)
        return await record_path(self._s, step, recorder, self._control, self.way, self._remainder)

    async def _zeroed(self) -> None:
        laser = self._s.need_laser()
        try:
            await laser.clear_beam()
            await laser.set_environment_compensation(True)  # without it every length is 270 ppm too long
            await laser.zero()
        except Refused as error:
            raise BeamLost(f"the laser cannot be zeroed: {error.detail}", "free the beam; the test begins again") from error

    async def _kept(self, record: dict[str, Any], recorder: Recorder) -> None:
        await recorder.add_record(record)
        self.records.append(record)

    async def _move(self, target: Point, feed_mm_min: float, here: Point | None, *, guarded: bool = False) -> None:
        seconds = 60.0 if here is None else math.dist(here, target) / feed_mm_min * 60.0
        if guarded:
            await guarded_move(self._s.controller, target, feed_mm_min=feed_mm_min, timeout_s=30.0 + 3.0 * seconds)
            check_interlocks(await self._s.controller.status())
            return
        status = await self._s.controller.move(target, feed_mm_min=feed_mm_min, timeout_s=30.0 + 3.0 * seconds)
        check_interlocks(status)

    async def _settled(self, settle_s: float) -> ControllerStatus:
        status = await self._s.controller.status()
        while status.ctrl_us < status.in_position_us + settle_s * 1e6:
            await asyncio.sleep(0.001)
            status = await self._s.controller.status()
        check_interlocks(status)
        return status

    async def _laser_record(self, status: ControllerStatus, here: Point | None, direction: int) -> dict[str, Any]:
        laser = self._s.need_laser()
        before = await laser.read()
        reading = await laser.read(after_count=before.sample_count)  # a sample that began after the axes had settled
        if not air_is_compensated(reading.status):
            raise MeasurementFault("the laser's environmental compensation was switched off during the run", "start the test again")
        return {
            "host_s": reading.host_s,
            "ctrl_us": status.ctrl_us,
            "target_mm": list(here if here is not None else status.position_mm),
            "direction": direction,
            "displacement_tenth_nm": reading.displacement_tenth_nm,
            "status": reading.status,
            "signal_permille": reading.signal_permille,
            "feed_mm_min": 0.0,
            **air_doc(reading),
        }
