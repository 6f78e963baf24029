"""The simulated world: one machine and its instruments, whose common clock moves with ``advance``."""

from dataclasses import replace

import numpy as np

from abbe.simulators.arrays import F
from abbe.simulators.artefact.table import OVERTRAVEL_S, PlateUnderProbe
from abbe.simulators.ballbar.device import BallbarDevice
from abbe.simulators.cnc.device import ALARM_CRASH, NOTHING, Controller, Felt
from abbe.simulators.hidden.live import live_of
from abbe.simulators.laser.device import RATE_HZ, LaserDevice
from abbe.simulators.scenario import Magnitudes, Scenario
from abbe.simulators.truth.draws import UM, Draws, draw_machine
from abbe.simulators.truth.machine import Geometry, Machine, Play
from abbe.simulators.truth.surroundings import Air, drift

# Each box was switched on at its own time: no two clocks agree.
BALLBAR_CLOCK_US = 12_345_678
LASER_CLOCK_US = 987_654_321


class World:
    """Everything that is simulated, at one instant ``time_s`` (s since the controller was switched on).

    Nothing here sleeps or reads the wall clock. Commands to the devices take effect at ``time_s``.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.time_s = 0.0
        geometry = Geometry(scenario.machine)
        self.hidden = live_of(scenario.hidden, geometry.low_mm, geometry.high_mm)
        self.draws = with_hidden_bar(draw_machine(scenario), scenario)
        self.machine = Machine(geometry, self.draws)
        # a host's lease runs in wall time, see Compensation
        self.controller = Controller(geometry, lease_scale=scenario.speed)
        self.ballbar = BallbarDevice(self.draws, scenario.magnitudes, self.locate, clock_offset_us=BALLBAR_CLOCK_US)
        self.air = Air(scenario.seed)
        self.laser = LaserDevice(self.draws, laser_sizes(scenario), self.air, self.locate, self.machine.turned)
        if self.hidden is not None:
            self.laser.too_much = self.hidden.laser_mm
            self.ballbar.too_much = self.hidden.bar_mm
        self.table = PlateUnderProbe(scenario, geometry.tool_mm)
        self.controller.feel = self._felt
        self.controller.probe_fitted = lambda: self.table.fitted
        self.controller.deflected = self._deflected
        self._play = Play(self.draws.backlash_mm, self.controller.position_mm)
        self._laser_tick = 0
        self.laser.record(0, 0.0, self._play.position_mm)

    def advance(self, to_s: float) -> None:
        """Advance to an instant (s); an earlier one changes nothing.

        On the way, the world evaluates in order the instants of all bar samples, of the last laser sample, and of possible reversals.
        """
        if to_s <= self.time_s:
            return
        bar_s = self.ballbar.due_s(to_s)
        tick = self.laser.tick_before(to_s)
        tick_s = np.array([tick / RATE_HZ]) if tick > self._laser_tick else np.empty(0)
        times = np.concatenate([bar_s, tick_s, self.controller.turning_times(to_s), [to_s]])
        order = np.argsort(times, kind="stable")
        axes = np.empty((len(times), 3))
        axes[order] = self._axes(times[order])
        if len(bar_s):
            self.ballbar.record(axes[: len(bar_s)], self.controller.sync_level(bar_s))
        if len(tick_s):
            self.laser.record(tick, float(tick_s[0]), axes[len(bar_s)])
            self._laser_tick = tick
        self.controller.advance(to_s)
        self.time_s = to_s
        self.table.temperature_c = self.air.at(to_s).temperature_c
        if self.controller.alarm == ALARM_CRASH:
            self.table.stylus.broken = True

    def locate(self, times_s: F, axes_mm: F) -> F:
        """Return the actual tool position in workpiece coordinates at n instants with the axes at (n, 3) mm: (n, 3) mm, drift included."""
        return self.machine.tool_position(axes_mm) + drift(self.draws, times_s)

    def tool_position(self) -> F:
        """Return the actual tool position now, (3,) mm."""
        axes = self._axes(np.array([self.time_s]))
        actual: F = self.locate(np.array([self.time_s]), axes)[0]
        return actual

    def add_scale(self, axis: int, scale: float) -> None:
        """Add a scale error (mm/mm) to an axis from now on; earlier samples do not change."""
        self.ballbar.settle()
        self.laser.output()
        self.machine.extra_scale[axis] += scale

    def warm_air(self, plus_c: float) -> None:
        """Make the air warmer by ``plus_c`` K from now on; earlier samples do not change."""
        self.laser.output()
        self.air.warmer_c += plus_c

    def _deflected(self) -> bool:
        """Whether the probe's stylus is pushed aside now. Far from the plate it is not, wherever the machine's errors put it."""
        near = self.table.fitted and self.table.near(self.controller.position_mm + self.machine.geometry.tool_mm, self.time_s)
        return near and self.table.deflected(self.tool_position(), self.time_s)

    def _felt(self, start_mm: F, target_mm: F, feed_mm_min: float) -> Felt:
        """Return the contacts of the probe on a straight move from now on, without changing the present state of the lost motion."""
        way, length = target_mm - start_mm, float(np.linalg.norm(target_mm - start_mm))
        if not self.table.fitted or length == 0.0:
            return NOTHING
        speed = feed_mm_min / 60.0

        def tip(shares: F) -> F:
            times = self.time_s + shares * length / speed
            command = start_mm + shares[:, None] * way
            drives: F = command + self.controller.comp.correction(command)
            axes = self._play.ahead(drives)
            if self.hidden is not None:
                axes = axes + self.hidden.displacement(times, drives)
            return self.locate(times, axes)

        trip = self.table.contact(length, way / length, tip, self.time_s)
        stop = length if trip is None else min(length, trip + OVERTRAVEL_S * speed)
        return Felt(trip, stop, self.table.crash(length, tip, self.time_s))

    def _axes(self, times_s: F) -> F:
        """Return the axis positions at n ordered instants from now on, (n, 3) mm; lost motion and hidden effects remember them."""
        drives = self._drives(times_s)
        axes = self._play.run(drives)
        return axes if self.hidden is None else np.asarray(axes + self.hidden.displacement(times_s, drives))

    def _drives(self, times_s: F) -> F:
        """Return the drive positions at n instants from now on: command + correction, (n, 3) mm."""
        command = self.controller.commanded(times_s)
        driven: F = command + self.controller.comp.correction(command)
        return driven


def with_hidden_bar(draws: Draws, scenario: Scenario) -> Draws:
    """Return the draws, with the bar length error of a hidden effect added."""
    if scenario.hidden.name != "bar_length_error":
        return draws
    return replace(draws, bar_length_error_mm=draws.bar_length_error_mm + scenario.hidden.parameters["strength"] * UM)


def laser_sizes(scenario: Scenario) -> Magnitudes:
    """Return the magnitudes for the laser; a hidden ``laser_cosine`` sets the misalignment of every beam to about its strength."""
    if scenario.hidden.name != "laser_cosine":
        return scenario.magnitudes
    askew = 1e3 * scenario.hidden.parameters["strength"]
    return replace(scenario.magnitudes, beam_misalignment_urad=(0.97 * askew, 1.03 * askew))
