"""The world: one machine and the instruments that watch it, moved on by one ``advance``."""

import numpy as np

from simulators.arrays import F
from simulators.ballbar.device import BallbarDevice
from simulators.cnc.device import Controller
from simulators.laser.device import RATE_HZ, LaserDevice
from simulators.scenario import Scenario
from simulators.truth.draws import draw_machine
from simulators.truth.machine import Geometry, Machine
from simulators.truth.play import Play
from simulators.truth.surroundings import Air, drift

# Each box was switched on at its own time: no two clocks agree.
BALLBAR_CLOCK_US = 12_345_678
LASER_CLOCK_US = 987_654_321


class World:
    """Everything that is simulated, at one instant ``time_s`` (s since the controller was switched on).

    Nothing here sleeps or knows wall time. Commands to the devices take effect at the instant last advanced to.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.time_s = 0.0
        self.draws = draw_machine(scenario)
        geometry = Geometry(scenario.machine)
        self.machine = Machine(geometry, self.draws)
        # a host's lease lives in wall time, see Compensation
        self.controller = Controller(geometry, lease_scale=scenario.speed)
        self.ballbar = BallbarDevice(self.draws, scenario.magnitudes, self.locate, clock_offset_us=BALLBAR_CLOCK_US)
        self.laser = LaserDevice(self.draws, scenario.magnitudes, Air(scenario.seed), self.locate)
        self._play = Play(self.draws.backlash_mm, self.controller.position_mm)
        self._laser_tick = 0
        self.laser.record(0, 0.0, self._play.position_mm)

    def advance(self, to_s: float) -> None:
        """Move on to an instant; an earlier one does nothing.

        All instants at which something is read, and all at which an axis may turn round, are worked through in order.
        """
        if to_s <= self.time_s:
            return
        bar_s = self.ballbar.due_s(to_s)
        tick = self.laser.tick_before(to_s)
        tick_s = np.array([tick / RATE_HZ]) if tick > self._laser_tick else np.empty(0)
        times = np.concatenate([bar_s, tick_s, self.controller.turning_times(to_s), [to_s]])
        order = np.argsort(times, kind="stable")
        axes = np.empty((len(times), 3))
        axes[order] = self._play.run(self._drives(times[order]))
        if len(bar_s):
            self.ballbar.record(axes[: len(bar_s)], self.controller.sync_level(bar_s))
        if len(tick_s):
            self.laser.record(tick, float(tick_s[0]), axes[len(bar_s)])
            self._laser_tick = tick
        self.controller.advance(to_s)
        self.time_s = to_s

    def locate(self, times_s: F, axes_mm: F) -> F:
        """Actual tool position in workpiece coordinates at n instants with the axes at (n, 3) mm: (n, 3) mm, drift included."""
        return self.machine.tool_position(axes_mm) + drift(self.draws, times_s)

    def tool_position(self) -> F:
        """Actual tool position now, (3,) mm."""
        axes = self._play.run(self._drives(np.array([self.time_s])))
        actual: F = self.locate(np.array([self.time_s]), axes)[0]
        return actual

    def add_scale(self, axis: int, scale: float) -> None:
        """Let an axis grow a scale error (mm/mm) from now on; what was sampled before is not changed."""
        self.ballbar.settle()
        self.laser.output()
        self.machine.extra_scale[axis] += scale

    def _drives(self, times_s: F) -> F:
        """Where the drives are at n instants from now on: command + correction, (n, 3) mm."""
        command = self.controller.commanded(times_s)
        driven: F = command + self.controller.comp.correction(command)
        return driven
