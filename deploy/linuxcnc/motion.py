"""Moves, paths and holds of the register map, as G-code and signals of the control."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

FIFO_SIZE = 8192
ALARM_NONE, ALARM_ESTOP = 0, 1
_ARRIVED_MM = 1e-6
_BEYOND_MM = 1e-9
_SHORT_US, _LONG_US = 200_000, 2_000_000
"""If a motion was not seen to leave and to reach its target, it counts as over once the control has done nothing for this time: the short
one at the target or after a refusal, else the long one. The control accepts a line, and looks idle until its servo thread has run; on a
busy computer without real time nothing bounds how long that takes.
"""
# Absolute, mm, mm/min, no tool offsets or cutter radius; corners blended within 1 um, and no point left out (Q0).
_MODES = "G21 G90 G94 G17 G40 G49 G80"
_HEADER = (_MODES, "G64 P0.001 Q0")

Point = tuple[float, float, float]


class Result(IntEnum):
    """Result of a command, as in the registers MOTION_RESULT and FIFO_RESULT."""

    OK = 0
    BAD_ARGUMENT = 1
    INTERLOCK = 2
    STROKE_LIMIT = 3
    FIFO_FULL = 4
    BUSY = 5
    NO_PROBE = 6


class Hold(IntEnum):
    """Run, hold or abort, as in the register HOLD_REQUEST."""

    RUN = 0
    HOLD = 1
    ABORT = 2


@dataclass
class _Pending:
    target_mm: Point
    is_path: bool
    points: int
    aborted: bool = False
    touch_from_mm: Point | None = None
    """Position at which a touch began; None: the move is not a touch."""


class Motion:
    """Commands of the bridge to the control, and their progress.

    Parameters
    ----------
    control : Control
        The control (any object with its methods).
    now_us : callable
        Controller time in microseconds.
    program : Path
        File for path programs.
    """

    def __init__(self, control: Any, now_us: Callable[[], int], program: Path) -> None:
        self._control, self._now_us, self._program = control, now_us, program
        self.state = control.snapshot()
        self.hold = Hold.RUN
        self.alarm = ALARM_ESTOP if self.state.estop else ALARM_NONE
        self.done = 0
        """Motions finished since the start."""
        self.path_start_us = self.path_end_us = self.in_position_us = 0
        self.latch: tuple[Point, int] | None = None
        """Position and time at which the probe tripped in the last touch; None: it did not trip."""
        self.fifo: list[Point] = []
        self._pending: _Pending | None = None
        self._path_points = 0
        self._idle_us: int | None = None
        self._left = False
        control.hold(on=False)
        control.path_output(on=False)

    # ---- reading -----------------------------------------------------------------------------------------------------------------

    @property
    def moving(self) -> bool:
        """Whether a motion of this bridge is under way, or any axis moves."""
        return self._pending is not None or not self.state.in_position

    @property
    def path_running(self) -> bool:
        """Whether a path of this bridge is under way."""
        return self._pending is not None and self._pending.is_path

    @property
    def program_running(self) -> bool:
        """Whether a program that this bridge did not start is under way."""
        return self._pending is None and self.state.interpreting

    @property
    def held(self) -> bool:
        """Whether feed hold acts: it was requested, or the door is open."""
        return self.hold == Hold.HOLD or self.state.door_open

    @property
    def fifo_free(self) -> int:
        """Number of path points that still fit."""
        running = self._pending.points - self.points_done if self.path_running and self._pending else 0
        return FIFO_SIZE - len(self.fifo) - running

    @property
    def points_done(self) -> int:
        """Number of points that the running path, or else the last one, has reached."""
        if self._pending is None or not self._pending.is_path:
            return self._path_points
        # At rest the control still shows the line of the program before.
        line = 0 if self.state.in_position else self.state.line
        return min(max(line - len(_HEADER) - 2, self._path_points), self._pending.points)

    @property
    def latch_period_us(self) -> int:
        """Period at which the control reads the probe, µs."""
        return self._control.latch_period_us

    def may_move(self) -> bool:
        """Whether the interlocks of motion hold."""
        s = self.state
        blocked = s.estop or s.door_open or s.spindle or self.alarm != ALARM_NONE or self.program_running
        return not blocked and s.remote and s.homed and s.drives_on

    # ---- time --------------------------------------------------------------------------------------------------------------------

    def tick(self) -> None:
        """Read the control's state and finish the motions that have ended."""
        self.state = self._control.snapshot()
        if self.state.estop and self.alarm != ALARM_ESTOP:
            self.alarm = ALARM_ESTOP
            self._control.estop()  # also when the button was pressed for so short a time that the control has missed it
        if self._pending is None:
            return
        if self.state.estop or not self.state.drives_on:
            self.fifo.clear()
            self._end(counts=False)
            return
        self._path_points = self.points_done if self._pending.is_path else self._path_points
        arrived = max(abs(a - b) for a, b in zip(self.state.position_mm, self._pending.target_mm, strict=True)) < _ARRIVED_MM
        self._left = self._left or not arrived
        if arrived and self._left and self.state.in_position and self.state.queue == 0 and not self.in_position_us:
            self.in_position_us = self._now_us()
        if not self.state.ready:
            self._idle_us = None
        else:
            begun = self._pending.touch_from_mm
            if begun is not None and self.state.tripped and not self._pending.aborted and begun != self.state.position_mm:  # no old trip
                self.latch = self.state.probed_mm, self._now_us()
            self._idle(arrived=arrived, stopped=self._pending.aborted or self.latch is not None)

    def _idle(self, *, arrived: bool, stopped: bool) -> None:
        """End the motion of an idle control, unless it may not have begun: at the end of a closed path the position does not show which."""
        self._idle_us = self._now_us() if self._idle_us is None else self._idle_us
        enough_us = _SHORT_US if arrived or self.state.refused else _LONG_US
        if stopped or (arrived and self._left) or self._now_us() - self._idle_us >= enough_us:
            if arrived and self._pending is not None and self._pending.is_path:
                self._path_points = self._pending.points
            self._end(counts=arrived or stopped)

    def _end(self, *, counts: bool) -> None:
        self.in_position_us = self.in_position_us or self._now_us()
        if self._pending is not None and self._pending.is_path:
            self.path_end_us = self.in_position_us
            self._control.path_output(on=False)
        self._pending = None
        self.done += int(counts)

    # ---- commands ----------------------------------------------------------------------------------------------------------------

    def move(self, target_mm: Point, feed_mm_min: float) -> Result:
        """Go straight to a target in machine coordinates."""
        refusal = self._refusal(feed_mm_min) or self._strokes([target_mm])
        if refusal:
            return refusal
        self._begin(_Pending(target_mm, is_path=False, points=0))
        self._control.mdi(f"{_MODES} G61 {_line(target_mm)} F{feed_mm_min:.2f}")
        return Result.OK

    def touch(self, target_mm: Point, feed_mm_min: float) -> Result:
        """Go straight to a target until the probe trips (G38.3: to reach the target without a contact is not an error)."""
        refusal = self._refusal(feed_mm_min) or self._strokes([target_mm])
        if refusal or not self.state.probe_ready or self.state.deflected:
            return refusal or Result.NO_PROBE
        zero = self._control.work_offset_mm()
        if zero is None:
            return Result.BAD_ARGUMENT
        self._begin(_Pending(target_mm, is_path=False, points=0, touch_from_mm=self.state.position_mm))
        x, y, z = (t - o for t, o in zip(target_mm, zero, strict=True))
        self._control.mdi(f"{_MODES} G61 G38.3 X{x:.9f} Y{y:.9f} Z{z:.9f} F{feed_mm_min:.2f}")
        return Result.OK

    def path_clear(self) -> Result:
        """Empty the FIFO."""
        if self._pending is not None:
            return Result.BUSY
        self.fifo.clear()
        return Result.OK

    def push(self, points_mm: list[Point]) -> Result:
        """Store path points. A running path cannot be extended, because the control already executes it as a program."""
        if self.path_running:
            return Result.BUSY
        refusal = self._strokes(points_mm)
        if not refusal and len(points_mm) > self.fifo_free:
            return Result.FIFO_FULL
        if not refusal:
            self.fifo += points_mm
        return refusal

    def path_start(self, feed_mm_min: float) -> Result:
        """Run all points in the FIFO as one program."""
        refusal = self._refusal(feed_mm_min)
        if refusal:
            return refusal
        if not self.fifo or feed_mm_min / 60.0 > self._control.fastest_mm_s:
            return Result.BAD_ARGUMENT
        points, self.fifo = self.fifo, []
        text = "\n".join([*_HEADER, f"F{feed_mm_min:.2f}", *(_line(p) for p in points), "M2"])
        self._program.write_text(text + "\n", encoding="ascii")
        self._path_points, self.path_end_us = 0, 0
        self._begin(_Pending(points[-1], is_path=True, points=len(points)))
        self._control.path_output(on=True)
        self.path_start_us = self._now_us()
        self._control.run(self._program)
        return Result.OK

    def reset_alarm(self) -> Result:
        """Switch the machine on again after an e-stop was released."""
        if not self._control.snapshot().drives_on:
            self._control.switch_on()
            self.state = self._control.snapshot()
        if self.state.estop or not self.state.drives_on:
            return Result.INTERLOCK
        self.alarm = ALARM_NONE
        return Result.OK

    def request_hold(self, request: Hold) -> None:
        """Run, hold or abort, as the register HOLD_REQUEST demands."""
        self.hold = request
        self._control.hold(on=request == Hold.HOLD)
        if request == Hold.ABORT:
            self.fifo.clear()
            if self._pending is not None and not self._pending.aborted:
                self._pending.aborted = True
                self._control.abort()

    def _begin(self, pending: _Pending) -> None:
        self._control.complaints()
        self.in_position_us, self.latch, self._idle_us, self._left = 0, None, None, False
        self._pending = pending

    def _refusal(self, feed_mm_min: float) -> Result:
        if self._pending is not None or (not self.state.in_position and not self.program_running):
            return Result.BUSY
        if not self.may_move() or self.hold == Hold.ABORT:
            return Result.INTERLOCK
        return Result.OK if feed_mm_min > 0.0 else Result.BAD_ARGUMENT

    def _strokes(self, points_mm: list[Point]) -> Result:
        low, high = self._control.low_mm, self._control.high_mm
        inside = all(low[n] - _BEYOND_MM <= p[n] <= high[n] + _BEYOND_MM for p in points_mm for n in range(3))
        return Result.OK if inside else Result.STROKE_LIMIT


def _line(point_mm: Point) -> str:
    x, y, z = point_mm
    return f"G53 G1 X{x:.5f} Y{y:.5f} Z{z:.5f}"
