"""Driver of a CNC controller: moves, paths, feed hold, and tables (from `Banks`). A move that fails leaves the machine in feed hold."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager

from abbe.drivers.api import Condition, ControllerStatus, Latch, Point, ProbeState
from abbe.drivers.cnc import registers as reg
from abbe.drivers.cnc.banks import Banks
from abbe.drivers.errors import DeviceFault, DriverError, Refused, ReplyTimeout, run_to_end
from abbe.drivers.links.modbus_link import ModbusLink, ModbusOperation
from abbe.drivers.links.words import next_number, run_numbered

_POLL_S = 0.003
_HOLD_S = 3.0
_HOLD_AGAIN_S = 0.05
_INTERLOCK = 2
_STOP_S = 5.0


class ModbusController(Banks):
    """A CNC controller with the register map of docs/protocols/cnc.md.

    Every method may raise ``LinkDown``, ``ReplyTimeout`` or ``BadFrame`` (communication failed) and ``Rebooted`` (the controller restarted
    since ``identify``; call ``identify`` again to accept that). Several tasks may call methods concurrently: only single requests exclude
    each other, so ``hold``, ``abort``, ``resume`` and ``status`` work while a move is pending.
    """

    def __init__(self, link: ModbusLink) -> None:
        super().__init__(link)
        self._commands = asyncio.Lock()  # held during numbering and acknowledge of a command, never while the axes move

    async def move(self, target_mm: Point, *, feed_mm_min: float, timeout_s: float) -> ControllerStatus:
        """Move straight to a target (commanded X, Y, Z in mm), wait until the axes stand there, and return the controller's status then.

        On cancellation, timeout (``timeout_s`` host seconds for the whole move) or failure while the axes move, the driver sends a feed
        hold before it raises the error.

        Raises
        ------
        Refused
            Nothing moved: target beyond the strokes, interlock, busy, feed hold on.
        DeviceFault
            E-stop, alarm, door, feed hold or abort during the move.
        ReplyTimeout
            Not in position in time.
        """
        block = await self._moved(reg.MOVE, "move", target_mm, feed_mm_min, timeout_s)
        return self._at_target(block, "move", target_mm)

    async def probe_state(self) -> ProbeState:
        """Return whether a touch probe is fitted and deflected."""
        return (await self.block()).probe

    async def touch(self, target_mm: Point, *, feed_mm_min: float, timeout_s: float) -> Latch | None:
        """Move as `move` does, but stop the axes when the touch probe trips; return the position of the trip, None if it did not trip.

        Raises
        ------
        Refused, DeviceFault, ReplyTimeout
            As `move`; refused, too, without a probe.
        """
        block = await self._moved(reg.TOUCH, "touch", target_mm, feed_mm_min, timeout_s)
        if block.latch_seq == block.motion_done_seq:
            return block.latch
        self._at_target(block, "touch", target_mm)
        return None

    async def _moved(self, command: int, operation: str, target_mm: Point, feed_mm_min: float, timeout_s: float) -> reg.StatusBlock:
        """Command a straight motion, wait until it has ended, and return the controller's status then."""
        target = self._counts(target_mm, operation)
        try:
            async with self._hold_on_trouble(), asyncio.timeout(timeout_s):
                number = await self._command(command, operation, target, feed_mm_min)
                return await self._done(number)
        except TimeoutError as error:
            if isinstance(error, DriverError):
                raise
            late = ReplyTimeout(
                self.name,
                operation,
                f"not in position after {timeout_s:g} s; Abbe set feed hold",
                "check that the feed override is not at zero",
            )
            raise _with_notes(late, error) from None

    def _at_target(self, block: reg.StatusBlock, operation: str, target_mm: Point) -> ControllerStatus:
        if self._counts(block.status.position_mm, operation) != self._counts(target_mm, operation):
            detail = (
                f"the {operation} ended at {block.status.position_mm} mm instead of {tuple(target_mm)} mm: somebody or something aborted it"
            )
            raise DeviceFault(self.name, operation, detail, "find the reason, then start again")
        return block.status

    async def load_path(self, points_mm: Sequence[Point]) -> None:
        """Clear the controller's path and load these points (mm); nothing moves.

        Raises
        ------
        Refused
            Too many points, or one beyond the strokes.
        DeviceFault
            The controller received another number of points.
        """
        points = [self._counts(point, "load path") for point in points_mm]
        if len(points) > self.fifo_size:
            detail = f"{len(points)} points, but the controller holds at most {self.fifo_size}"
            raise Refused(self.name, "load path", detail, "use fewer points")
        await self._command(reg.PATH_CLEAR, "clear path")
        for first in range(0, len(points), reg.MAX_CHUNK):
            await self._chunk(points[first : first + reg.MAX_CHUNK], f"load path points {first}..")
        block = await self.block()
        if block.fifo_free != self.fifo_size - len(points):
            detail = f"{self.fifo_size - block.fifo_free} points arrived instead of {len(points)}"
            raise DeviceFault(self.name, "load path", detail, "end every other program that loads paths, then load the path again")

    async def start_path(self, *, feed_mm_min: float) -> None:
        """Start the loaded path at constant feed (mm/min) and return as soon as it runs; ``status`` shows its progress.

        Raises
        ------
        Refused
            Interlock, busy, empty path, feed hold on.
        """
        async with self._hold_on_trouble():
            await self._command(reg.PATH_START, "start path", feed_mm_min=feed_mm_min)

    async def hold(self) -> None:
        """Stop the axes on their path; ``resume`` continues the motion, ``abort`` discards it. Works at any time."""
        await self.request_hold(reg.HOLD)

    async def resume(self) -> None:
        """Release feed hold: an interrupted motion continues."""
        await self.request_hold(reg.RUN)

    async def reset_alarm(self) -> None:
        """Reset the controller's alarm. Raises ``Refused`` while the cause of the alarm persists."""
        await self._command(reg.RESET_ALARM, "reset alarm")

    async def request_hold(self, level: int) -> None:
        """Write register HOLD_REQUEST: RUN, HOLD or ABORT. This is a level, not an event, so the link may repeat the write."""
        await self.link.write(reg.HOLD_ADDRESS, (level,), ModbusOperation.LEVEL)

    async def abort(self) -> None:
        """Stop the axes, forget the motion and the path, and leave the controller ready for the next motion.

        Raises
        ------
        ReplyTimeout
            The axes still move after 5 s.
        """
        await self.request_hold(reg.ABORT)
        try:
            async with asyncio.timeout(_STOP_S):
                await self._standstill()
        except TimeoutError as error:
            if isinstance(error, DriverError):
                raise
            raise ReplyTimeout(self.name, "abort", f"the axes still move {_STOP_S:g} s after the abort", "press the e-stop") from None
        await self.request_hold(reg.RUN)

    async def _standstill(self) -> None:
        while True:
            status = await self.status()
            if not (status.moving or status.path_running):
                return
            await asyncio.sleep(_POLL_S)

    @asynccontextmanager
    async def _hold_on_trouble(self) -> AsyncIterator[None]:
        try:
            yield
        except (Refused, _MotionStopped):
            raise  # no motion of ours runs
        except BaseException as error:
            # Cancellation, timeout, lost link, alarm: in every case the axes must not run on unattended.
            await self._hold_quietly(error)
            raise

    async def _hold_quietly(self, reason: BaseException) -> None:
        async def hold() -> None:
            try:
                async with asyncio.timeout(_HOLD_S):
                    await self._retry_hold()
            except (DriverError, TimeoutError) as error:
                reason.add_note(f"and the feed hold could not be sent: {error}")

        await run_to_end(hold())

    async def _retry_hold(self) -> None:
        """Retry the feed hold as often as the link permits: a lost controller may return with moving axes."""
        while True:
            try:
                return await self.request_hold(reg.HOLD)
            except DriverError as error:
                if not error.retryable:
                    raise
            await asyncio.sleep(_HOLD_AGAIN_S)

    async def _command(self, command: int, operation: str, target: tuple[int, int, int] = (0, 0, 0), feed_mm_min: float = 0.0) -> int:
        async with self._commands:
            block = await self.block()
            reasons = reg.interlocks(block.status.conditions)  # an open door may also show as feed hold: report the door
            if Condition.FEED_HOLD in block.status.conditions and not reasons and command in (reg.MOVE, reg.TOUCH, reg.PATH_START):
                raise Refused(self.name, operation, "feed hold is on", "when it is safe, release feed hold or abort the motion")
            number = next_number(block.motion_ack_seq)
            try:
                words = reg.encode_motion(number, command, target, feed_mm_min)
            except ValueError as error:
                raise Refused(self.name, operation, str(error)) from None

            async def write() -> None:
                await self.link.write(reg.MOTION_ADDRESS, words, ModbusOperation.NUMBERED)

            async def acknowledge() -> tuple[int, int]:
                now = await self.block()
                return now.motion_ack_seq, now.motion_result

            result = await run_numbered(self.name, operation, number, write, acknowledge)
        if result:
            detail = reg.MOTION_RESULT.get(result, f"result {result}") + (f": {', '.join(reasons)}" if reasons else "")
            # HOLD_REQUEST at 2 forbids motion without showing in the status
            unseen = "abort once more, in case an earlier abort was not finished; then " if result == _INTERLOCK and not reasons else ""
            raise Refused(self.name, operation, detail, f"{unseen}look at the machine, then try again")
        return number

    async def _done(self, number: int) -> reg.StatusBlock:
        while True:
            block = await self.block()
            # Faults first: after an alarm the controller may count the command as done.
            self._check(block)
            if block.motion_done_seq == number:
                return block
            if Condition.FEED_HOLD in block.status.conditions:
                raise _MotionStopped(self.name, "move", "stopped by feed hold", "when it is safe, release feed hold or abort the motion")
            if block.motion_ack_seq != number:
                detail = f"command {block.motion_ack_seq} replaced command {number}, which was not finished"
                raise DeviceFault(self.name, "move", detail, "end every other program that moves this machine")
            await asyncio.sleep(_POLL_S)

    def _check(self, block: reg.StatusBlock) -> None:
        conditions = block.status.conditions
        if Condition.ESTOP in conditions:
            raise DeviceFault(
                self.name,
                "move",
                "e-stop pressed",
                "release the e-stop, reset the alarm, reference the axes if the control asks for it, then start again",
            )
        if Condition.ALARM in conditions or block.alarm_code:
            what = reg.ALARM.get(block.alarm_code, f"code {block.alarm_code}")
            raise DeviceFault(self.name, "move", f"alarm: {what}", "remove the cause of the alarm, then reset the alarm at the controller")
        if Condition.DOOR_OPEN in conditions:
            raise DeviceFault(self.name, "move", "door opened", "close the door, then start again")

    async def _chunk(self, points: list[tuple[int, int, int]], operation: str) -> None:
        async with self._commands:
            number = next_number((await self.block()).fifo_ack_seq)

            async def write() -> None:
                await self.link.write(reg.FIFO_ADDRESS, reg.encode_fifo(number, points), ModbusOperation.NUMBERED)

            async def acknowledge() -> tuple[int, int]:
                now = await self.block()
                return now.fifo_ack_seq, now.fifo_result

            result = await run_numbered(self.name, operation, number, write, acknowledge)
        if result:
            raise Refused(self.name, operation, reg.MOTION_RESULT.get(result, f"result {result}"), "check the path against the strokes")

    def _counts(self, point_mm: Point, operation: str) -> tuple[int, int, int]:
        try:
            return reg.position_counts(point_mm)
        except ValueError as error:
            raise Refused(self.name, operation, str(error)) from None


def _with_notes(error: DriverError, former: BaseException) -> DriverError:
    """Copy the notes of an earlier error, such as one on a failed feed hold, to this error and return it."""
    for note in getattr(former, "__notes__", ()):
        error.add_note(note)
    return error


class _MotionStopped(DeviceFault):
    """A motion ended because the controller is in feed hold. The driver sends no further hold, which could undo a running abort."""
