"""The CNC controller as a state machine: interlocks, moves, paths, holds. No bytes; positions in mm, times in controller seconds."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from abbe.simulators.arrays import B, F
from abbe.simulators.cnc.compensation import Compensation
from abbe.simulators.truth.machine import Geometry


class Motion:
    """One polyline under way: the commanded point runs from the first to the last vertex at constant speed.

    Start and stop are instantaneous. Between two changes of speed the travelled length is linear in time, so any number of
    instants can be evaluated at once; a change of speed (hold, override) only moves the reference instant.
    """

    def __init__(self, vertices_mm: F, speed_mm_s: float, start_s: float) -> None:
        self._vertices = vertices_mm
        self._length = _lengths(vertices_mm)
        self._ref_s = start_s
        self._ref_mm = 0.0
        self._speed = speed_mm_s
        self._factor = 1.0

    @property
    def total_mm(self) -> float:
        """Length of the whole polyline."""
        return float(self._length[-1])

    @property
    def target_mm(self) -> F:
        """Last vertex, (3,) mm."""
        last: F = self._vertices[-1]
        return last

    @property
    def vertex_count(self) -> int:
        """Number of vertices without the starting point."""
        return len(self._vertices) - 1

    def set_factor(self, factor: float, now_s: float) -> None:
        """Change the speed to ``factor`` times the feed from ``now_s`` on (0 = feed hold)."""
        self._ref_mm = float(self.travelled(np.array([now_s]))[0])
        self._ref_s = now_s
        self._factor = factor

    def extend(self, vertices_mm: F) -> None:
        """Append vertices (n, 3) to the running polyline."""
        added = _lengths(np.vstack([self._vertices[-1:], vertices_mm]))[1:]
        self._length = np.concatenate([self._length, self.total_mm + added])
        self._vertices = np.vstack([self._vertices, vertices_mm])

    def travelled(self, times_s: F) -> F:
        """Return the length travelled at n instants, (n,) mm."""
        run = self._ref_mm + self._speed * self._factor * (times_s - self._ref_s)
        clipped: F = np.clip(run, 0.0, self.total_mm)
        return clipped

    def position(self, times_s: F) -> F:
        """Return the commanded point at n instants: (n, 3) mm."""
        run = self.travelled(times_s)
        return np.stack([np.interp(run, self._length, self._vertices[:, a]) for a in range(3)], axis=1)

    def end_s(self) -> float:
        """Return the instant of arrival at the present speed; infinity on hold."""
        rest = self.total_mm - self._ref_mm
        speed = self._speed * self._factor
        if rest <= 0.0:
            return self._ref_s
        return self._ref_s + rest / speed if speed > 0.0 else float("inf")

    def vertex_times(self, from_s: float, to_s: float) -> F:
        """Return the instants in (from_s, to_s] at which a vertex is passed: an axis can reverse there."""
        speed = self._speed * self._factor
        if speed <= 0.0:
            return np.empty(0)
        begin, end = self.travelled(np.array([from_s, to_s]))
        first, last = np.searchsorted(self._length, [begin, end], side="right")
        times: F = self._ref_s + (self._length[first:last] - self._ref_mm) / speed
        return times

    def vertices_reached(self, now_s: float) -> int:
        """Return the number of vertices reached, without the starting point."""
        run = float(self.travelled(np.array([now_s]))[0])
        # a thousandth of a nanometre tolerates the rounding of an arrival computed from its own instant
        return int(np.searchsorted(self._length[1:], run + 1e-9, side="right"))


def _lengths(vertices_mm: F) -> F:
    """Return the length of a polyline up to each vertex, (n,) mm."""
    steps = np.linalg.norm(np.diff(vertices_mm, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


class Timetable:
    """An NC program under way, with the methods of `Motion`: positions at knots of program time, linear in between.

    ``set_factor`` (feed hold, override) changes the speed of program time, also in a dwell.
    """

    def __init__(self, start_mm: F, blocks: list[tuple[F, float]], start_s: float) -> None:
        """``blocks``: target (3,) mm and the seconds to reach it; to dwell, repeat the current position."""
        self._knots = np.concatenate([[0.0], np.cumsum([seconds for _, seconds in blocks])])
        self._places = np.stack([start_mm, *(place for place, _ in blocks)])
        self._ref_s, self._ref, self._factor = start_s, 0.0, 1.0

    @property
    def total_mm(self) -> float:
        """Path length of the whole program."""
        return float(np.linalg.norm(np.diff(self._places, axis=0), axis=1).sum())

    @property
    def target_mm(self) -> F:
        """End position, (3,) mm."""
        last: F = self._places[-1]
        return last

    @property
    def vertex_count(self) -> int:
        """Number of blocks."""
        return len(self._places) - 1

    def set_factor(self, factor: float, now_s: float) -> None:
        """Let program time run at ``factor`` times its normal speed from ``now_s`` on."""
        self._ref = self._program_s(now_s)
        self._ref_s, self._factor = now_s, factor

    def extend(self, vertices_mm: F) -> None:
        """Raise ValueError: a program cannot be extended."""
        raise ValueError("an NC program runs")

    def position(self, times_s: F) -> F:
        """Return the commanded point at n instants: (n, 3) mm."""
        program = np.clip(self._ref + self._factor * (times_s - self._ref_s), 0.0, self._knots[-1])
        return np.stack([np.interp(program, self._knots, self._places[:, a]) for a in range(3)], axis=1)

    def end_s(self) -> float:
        """Return the instant at which the program ends at the present factor; infinity on hold."""
        rest = float(self._knots[-1]) - self._ref
        if rest <= 0.0:
            return self._ref_s
        return self._ref_s + rest / self._factor if self._factor > 0.0 else float("inf")

    def vertex_times(self, from_s: float, to_s: float) -> F:
        """Return the instants in (from_s, to_s] at which a block ends: an axis can reverse there."""
        if self._factor <= 0.0:
            return np.empty(0)
        times: F = self._ref_s + (self._knots - self._ref) / self._factor
        return times[(times > from_s) & (times <= to_s)]

    def vertices_reached(self, now_s: float) -> int:
        """Return the number of blocks done."""
        return int(np.searchsorted(self._knots[1:], self._program_s(now_s) + 1e-12, side="right"))

    def _program_s(self, now_s: float) -> float:
        return float(np.clip(self._ref + self._factor * (now_s - self._ref_s), 0.0, self._knots[-1]))


FIFO_SIZE = 8192
_TOLERANCE_MM = 1e-9


class Result(IntEnum):
    """Result of a motion or FIFO command, as in the registers MOTION_RESULT and FIFO_RESULT."""

    OK = 0
    BAD_ARGUMENT = 1
    INTERLOCK = 2
    STROKE_LIMIT = 3
    FIFO_FULL = 4
    BUSY = 5
    NO_PROBE = 6


@dataclass(frozen=True, slots=True)
class Felt:
    """Contacts of a straight move: lengths at which the probe trips (None: never), the axes stop, and the stylus breaks (None: never)."""

    trip_mm: float | None = None
    stop_mm: float = 0.0
    crash_mm: float | None = None


NOTHING = Felt()
Feel = Callable[[F, F, float], Felt]
"""Maps start and target (3,) mm and feed (mm/min) of a straight move to its contacts."""


class Hold(IntEnum):
    """Run, hold or abort, as in the register HOLD_REQUEST."""

    RUN = 0
    HOLD = 1
    ABORT = 2


ALARM_NONE, ALARM_ESTOP, ALARM_STROKE, ALARM_CRASH = 0, 1, 2, 4


@dataclass(slots=True)
class Switches:
    """Inputs of the controller that people and the shop floor set."""

    estop: bool = False
    door_open: bool = False
    remote: bool = True
    referenced: bool = True
    program_running: bool = False
    spindle_turning: bool = False


class Controller:
    """The controller: its motion, and its compensation banks in ``comp``."""

    def __init__(self, geometry: Geometry, *, lease_scale: float = 1.0) -> None:
        self._low, self._high = geometry.low_mm, geometry.high_mm
        self.comp = Compensation(lease_scale)
        self.switches = Switches()
        self.now_s = 0.0
        self.position_mm: F = 0.5 * (self._low + self._high)
        self.alarm = ALARM_NONE
        self.drives_on = True
        self.override_percent = 100
        self.hold = Hold.RUN
        self.in_position = True
        self.in_position_s = 0.0
        self.motions_done = 0
        """Number of motions finished since boot; from this `CncRegisters` derives whether its last command has finished."""
        self.path_running = False
        self.path_start_s = 0.0
        self.path_end_s = 0.0
        self._path_points = 0
        self._fifo: list[tuple[float, float, float]] = []
        self._motion: Motion | Timetable | None = None
        self.feel: Feel = lambda _start, _target, _feed: NOTHING
        """What a move meets on its way; the world sets it."""
        self.probe_fitted: Callable[[], bool] = lambda: False
        self.deflected: Callable[[], bool] = lambda: False
        self.latch_mm: F | None = None
        """Position at which the probe tripped in the last touch, None if it did not trip; ``latch_s``: time of the trip."""
        self.latch_s = 0.0
        self._trip_mm: F | None = None
        self._crash = False

    # ---- reading -------------------------------------------------------------------------------------------------

    @property
    def moving(self) -> bool:
        """Whether a move, path or NC program is under way (also while held)."""
        return self._motion is not None

    @property
    def held(self) -> bool:
        """Whether feed hold acts: it was requested, or the door is open."""
        return self.hold == Hold.HOLD or self.switches.door_open

    @property
    def fifo_free(self) -> int:
        """Free places for path points: the total minus waiting points and points that the running path has not reached."""
        waiting = len(self._fifo)
        if self.path_running and self._motion is not None:
            waiting += self._motion.vertex_count - self.path_points_done
        return FIFO_SIZE - waiting

    @property
    def path_points_done(self) -> int:
        """Number of points that the running path, or the last one if none runs, has reached."""
        if self.path_running and self._motion is not None:
            return self._motion.vertices_reached(self.now_s)
        return self._path_points

    def may_move(self) -> bool:
        """Whether the motion interlocks hold."""
        s = self.switches
        blocked = s.estop or s.door_open or s.program_running or s.spindle_turning or self.alarm != ALARM_NONE
        return not blocked and s.remote and s.referenced and self.drives_on

    def commanded(self, times_s: F) -> F:
        """Return the commanded positions at n instants from now until the next command: (n, 3) mm."""
        if self._motion is None:
            return np.repeat(self.position_mm[None, :], times_s.size, axis=0)
        return self._motion.position(times_s)

    def turning_times(self, until_s: float) -> F:
        """Return the instants after now and up to ``until_s`` at which the commanded point passes a vertex."""
        return np.empty(0) if self._motion is None else self._motion.vertex_times(self.now_s, until_s)

    def sync_level(self, times_s: F) -> B:
        """Return the level of the path-running output at n instants from now on."""
        if not self.path_running or self._motion is None:
            return np.zeros(times_s.size, dtype=np.bool_)
        level: B = (times_s >= self.path_start_s) & (times_s < self._motion.end_s())
        return level

    # ---- time ----------------------------------------------------------------------------------------------------

    def advance(self, to_s: float) -> None:
        """Advance to ``to_s``. A motion that arrives earlier ends at the instant of its arrival, not at ``to_s``."""
        motion = self._motion
        if motion is not None:
            end_s = motion.end_s()
            if end_s <= to_s:
                self.now_s = max(end_s, self.now_s)
                self.position_mm = motion.target_mm.copy()
                self.latch_mm, self.latch_s = self._trip_mm, self.now_s
                if self._crash:
                    self.raise_alarm(ALARM_CRASH)
                else:
                    self._finish(motion.vertex_count)
            else:
                self.position_mm = motion.position(np.array([to_s]))[0]
        self.now_s = to_s

    # ---- commands ------------------------------------------------------------------------------------------------

    def move(self, target_mm: F, feed_mm_min: float) -> Result:
        """Go straight to a target."""
        refusal = self._refuse(feed_mm_min, target_mm[None, :])
        if refusal:
            return refusal
        self._go(target_mm, feed_mm_min, self.feel(self.position_mm, target_mm, feed_mm_min).crash_mm)
        return Result.OK

    def touch(self, target_mm: F, feed_mm_min: float) -> Result:
        """Go straight to a target until the probe trips; the axes then stop."""
        refusal = self._refuse(feed_mm_min, target_mm[None, :])
        if refusal or not self.probe_fitted() or self.deflected():
            return refusal or Result.NO_PROBE
        start, felt = self.position_mm, self.feel(self.position_mm, target_mm, feed_mm_min)
        if felt.trip_mm is None:
            self._go(target_mm, feed_mm_min, felt.crash_mm)
            return Result.OK
        way = (target_mm - start) / np.linalg.norm(target_mm - start)
        crash = felt.crash_mm if felt.crash_mm is not None and felt.crash_mm < felt.stop_mm else None
        self._go(start + felt.stop_mm * way, feed_mm_min, crash)
        self._trip_mm = start + felt.trip_mm * way
        return Result.OK

    def path_clear(self) -> Result:
        """Empty the FIFO."""
        if self.moving:
            return Result.BUSY
        self._fifo.clear()
        return Result.OK

    def path_start(self, feed_mm_min: float) -> Result:
        """Run all points in the FIFO from the current position."""
        refusal = self._refuse(feed_mm_min, np.empty((0, 3)))
        if refusal:
            return refusal
        if not self._fifo:
            return Result.BAD_ARGUMENT
        vertices = np.vstack([self.position_mm[None, :], np.array(self._fifo)])
        self._fifo.clear()
        self._trip_mm, self._crash = None, False
        self.path_running, self.path_start_s, self.path_end_s = True, self.now_s, 0.0
        self._start(vertices, feed_mm_min)
        return Result.OK

    def run_program(self, blocks: list[tuple[F, float]]) -> Result:
        """Run an NC program, as the operator starts it at the panel: positions (3,) mm with the seconds to reach each."""
        if self.moving:
            return Result.BUSY
        if not self.may_move():
            return Result.INTERLOCK
        if not self._inside(np.array([place for place, _ in blocks])):
            return Result.STROKE_LIMIT
        self.switches.program_running = True
        self._trip_mm, self._crash = None, False
        self._motion, self.in_position = Timetable(self.position_mm, blocks, self.now_s), False
        self._apply_speed()
        return Result.OK

    def fifo_push(self, points_mm: F) -> Result:
        """Store path points (n, 3) mm, or append them to the running path."""
        if not self._inside(points_mm):
            return Result.STROKE_LIMIT
        if len(points_mm) > self.fifo_free:
            return Result.FIFO_FULL
        if self.path_running and self._motion is not None:
            self._motion.extend(points_mm)
        else:
            self._fifo.extend((float(x), float(y), float(z)) for x, y, z in points_mm)
        return Result.OK

    def reset_alarm(self) -> Result:
        """Clear the alarm and switch the drives on again; refused while its cause lasts."""
        if self.switches.estop:
            return Result.INTERLOCK
        self.alarm, self.drives_on = ALARM_NONE, True
        self.in_position = not self.moving
        return Result.OK

    def request_hold(self, request: Hold) -> None:
        """Run, hold or abort, as written to the register HOLD_REQUEST."""
        self.hold = request
        if request == Hold.ABORT:
            self._fifo.clear()
            if self._motion is not None:
                self._finish(self.path_points_done)
        self._apply_speed()

    def set_override(self, percent: int) -> None:
        """Set the feed override."""
        self.override_percent = percent
        self._apply_speed()

    def set_door(self, *, is_open: bool) -> None:
        """Open or close the door; a motion is held while it is open."""
        self.switches.door_open = is_open
        self._apply_speed()

    def set_estop(self, *, pressed: bool) -> None:
        """Press or release the emergency stop: motion ends where it is and does not count as done."""
        self.switches.estop = pressed
        if pressed:
            self.drives_on = False
            self.raise_alarm(ALARM_ESTOP)

    def raise_alarm(self, code: int = ALARM_STROKE) -> None:
        """Raise an alarm: motion ends where it is and does not count as done."""
        self.alarm = code
        self._end_here()

    def drives_off(self) -> None:
        """Switch the drives off: motion ends where it is and does not count as done."""
        self.drives_on = False
        self._end_here()

    # ---- inner ---------------------------------------------------------------------------------------------------

    def _go(self, target_mm: F, feed_mm_min: float, crash_mm: float | None) -> None:
        """Start a straight motion. With ``crash_mm`` it ends in a crash after this length."""
        self.latch_mm, self._trip_mm, self._crash = None, None, crash_mm is not None
        end = target_mm
        if crash_mm is not None:
            end = self.position_mm + (target_mm - self.position_mm) * min(
                1.0, crash_mm / float(np.linalg.norm(target_mm - self.position_mm))
            )
        self._start(np.stack([self.position_mm, end]), feed_mm_min)

    def _end_here(self) -> None:
        self.in_position = False
        self._fifo.clear()
        if self._motion is not None:
            self._end_path(self.path_points_done)
            self._end_program()
            self._motion = None

    def _refuse(self, feed_mm_min: float, points_mm: F) -> Result:
        """Return why a motion to these points would be refused, or OK."""
        if self.moving:
            return Result.BUSY
        if not self.may_move() or self.hold == Hold.ABORT:
            return Result.INTERLOCK
        if not feed_mm_min > 0.0:
            return Result.BAD_ARGUMENT
        return Result.OK if self._inside(points_mm) else Result.STROKE_LIMIT

    def _inside(self, points_mm: F) -> bool:
        """Whether all points are within the strokes."""
        return bool(np.all((points_mm >= self._low - _TOLERANCE_MM) & (points_mm <= self._high + _TOLERANCE_MM)))

    def _start(self, vertices_mm: F, feed_mm_min: float) -> None:
        self._motion = Motion(vertices_mm, feed_mm_min / 60.0, self.now_s)
        self.in_position = False
        self._apply_speed()
        if self._motion.total_mm == 0.0:
            self._finish(self._motion.vertex_count)

    def _apply_speed(self) -> None:
        if self._motion is not None:
            self._motion.set_factor(0.0 if self.held else self.override_percent / 100.0, self.now_s)

    def _finish(self, points_done: int) -> None:
        """Count the motion as done, here and now."""
        self._end_path(points_done)
        self._end_program()
        self._motion = None
        self.in_position, self.in_position_s = True, self.now_s
        self.motions_done += 1

    def _end_program(self) -> None:
        if isinstance(self._motion, Timetable):
            self.switches.program_running = False

    def _end_path(self, points_done: int) -> None:
        if self.path_running:
            self._path_points, self.path_end_s, self.path_running = points_done, self.now_s, False
