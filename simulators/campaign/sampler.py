"""Readings of a ball-bar and a laser on the true machine, run after run, without device protocols: for statistics over many machines.

The formulas are those of `abbe.simulators.ballbar.device` and `abbe.simulators.laser.device`; the machine is `abbe.simulators.truth`.
"""

from dataclasses import dataclass

import numpy as np

from abbe.simulators.arrays import F
from abbe.simulators.laser.device import Mount
from abbe.simulators.scenario import Scenario
from abbe.simulators.truth.draws import UM, URAD, Draws, draw_machine, generator
from abbe.simulators.truth.machine import Geometry, Machine, Play
from abbe.simulators.truth.surroundings import drift

STREAM_SETUP, STREAM_NOISE, STREAM_LENGTH, STREAM_SCALE = range(20, 24)
LEAD_IN_MM = 1.0
"""Length of the approach to every run, in the direction of its first motion; longer than any lost motion."""


@dataclass(frozen=True, slots=True)
class Conditions:
    """Measuring conditions: standard deviation of one reading (``*_noise_mm``), share and size of outliers, errors of the instruments.

    ``bar_length_sd_mm``: standard deviation of each bar's length error (one bar per nominal radius). ``wavelength_sd``: standard
    deviation of the laser's relative scale error. ``pause_s``: time between two runs. ``drift``: whether the machine's thermal drift acts.
    """

    bar_noise_mm: float = 0.5e-3
    laser_noise_mm: float = 0.3e-3
    outlier_share: float = 0.005
    outlier_mm: tuple[float, float] = (5e-3, 50e-3)
    bar_length_sd_mm: float = 1.0e-3
    wavelength_sd: float = 0.3e-6
    pause_s: float = 120.0
    drift: bool = True


class Rig:
    """One machine under measurement. Runs follow each other: the axes keep the direction of their last motion, and the clock runs on."""

    def __init__(self, scenario: Scenario, conditions: Conditions | None = None) -> None:
        self.scenario = scenario
        self.conditions = conditions or Conditions()
        self.draws: Draws = draw_machine(scenario)
        self.geometry = Geometry(scenario.machine)
        self.time_s = 0.0
        self.wavelength_error = float(generator(scenario.seed, STREAM_SCALE).normal(scale=self.conditions.wavelength_sd))
        self._play = Play(self.draws.backlash_mm, self.geometry.high_mm)
        self._setup = generator(scenario.seed, STREAM_SETUP)
        self._noise = generator(scenario.seed, STREAM_NOISE)

    def machine(self, tool_mm: F | None = None) -> Machine:
        """Return the true machine with another tool offset (3,) mm; None: its own."""
        geometry = Geometry(self.scenario.machine)
        if tool_mm is not None:
            geometry.tool_mm = np.asarray(tool_mm, dtype=np.float64)
        return Machine(geometry, self.draws)

    def bar_length_error_mm(self, radius_mm: float) -> float:
        """Return the length error of the bar of this nominal radius, mm: a reading is distance - radius + this error."""
        rng = generator(self.scenario.seed, STREAM_LENGTH, round(1000 * radius_mm))
        return float(rng.normal(scale=self.conditions.bar_length_sd_mm))

    def cup(self, centre_mm: F, tool_mm: F | None = None) -> F:
        """Drive to a centre, set up the cup near the tool's actual position, and return the cup's position, (3,) mm."""
        at = self._locate(np.array([self.time_s]), np.asarray(centre_mm, dtype=np.float64)[None], tool_mm)[0]
        direction = self._setup.normal(size=3)
        size_mm = self._setup.uniform(*self.scenario.magnitudes.cup_offset_um) * UM
        cup: F = at + direction / np.linalg.norm(direction) * size_mm
        return cup

    def bar(
        self,
        axes_mm: F,
        centre_mm: F,
        radius_mm: float,
        tool_mm: F | None = None,
        t_s: F | None = None,
        cup_mm: F | None = None,
    ) -> F:
        """Return the readings of a ball-bar, distance minus nominal radius, (n,) mm.

        Parameters
        ----------
        axes_mm : array, shape (n, 3)
            Commanded positions of the samples, in the order of the motion.
        centre_mm : array, shape (3,)
            Nominal centre. The cup is set up there, unless ``cup_mm`` (from `cup`) is the position of a cup that is already set up.
        t_s : array, shape (n,), optional
            Instants; None: 33 samples per second from now on.
        """
        if cup_mm is None:
            cup_mm = self.cup(centre_mm, tool_mm)
        times = self._times(len(axes_mm), 0.03, t_s)
        distance = np.linalg.norm(self._locate(times, axes_mm, tool_mm) - cup_mm, axis=1)
        return self._read(distance - radius_mm + self.bar_length_error_mm(radius_mm), self.conditions.bar_noise_mm)

    def laser(self, axes_mm: F, beam: F, tool_mm: F | None = None, t_s: F | None = None) -> F:
        """Return the readings of a laser zeroed at the first position, displacement minus nominal, (n,) mm.

        Parameters
        ----------
        axes_mm : array, shape (n, 3)
            Commanded positions of the records.
        beam : array, shape (3,)
            Nominal beam, away from the laser. Beam and mirror are set up anew, both slightly misaligned.
        t_s : array, shape (n,), optional
            Instants; None: one record every 2 s from now on.
        """
        nominal = np.asarray(beam, dtype=np.float64) / np.linalg.norm(beam)
        sizes = self.scenario.magnitudes
        true_beam = nominal + self._sideways(nominal, sizes.beam_misalignment_urad)
        normal = nominal + self._sideways(nominal, sizes.mirror_tilt_urad)
        times = self._times(len(axes_mm), 2.0, t_s)
        where = self._locate(times, axes_mm, tool_mm)
        mount = Mount(true_beam / np.linalg.norm(true_beam), normal, where[0])
        path = mount.displacement(where, self.machine(tool_mm).turned(axes_mm)) * (1.0 + self.wavelength_error)
        return self._read(path - (axes_mm - axes_mm[0]) @ nominal, self.conditions.laser_noise_mm)

    def _locate(self, times_s: F, axes_mm: F, tool_mm: F | None) -> F:
        """Approach the first commanded position; return the actual tool positions at all of them, (n, 3) mm, with lost motion and drift."""
        first = np.array([_first_sign(axes_mm[:, a]) for a in range(3)])
        self._play.run(np.stack([axes_mm[0] - LEAD_IN_MM * first]))
        actual: F = self.machine(tool_mm).tool_position(self._play.run(axes_mm))
        if self.conditions.drift:
            actual = actual + drift(self.draws, times_s)
        return actual

    def _read(self, exact_mm: F, noise_mm: float) -> F:
        n = exact_mm.size
        c = self.conditions
        wrong = self._noise.random(n) < c.outlier_share
        size = self._noise.uniform(*c.outlier_mm, n) * self._noise.choice([-1.0, 1.0], n)
        reading: F = exact_mm + self._noise.normal(scale=noise_mm, size=n) + np.where(wrong, size, 0.0)
        return reading

    def _times(self, n: int, step_s: float, t_s: F | None) -> F:
        times: F = self.time_s + self.conditions.pause_s + step_s * np.arange(n, dtype=np.float64)
        if t_s is not None:
            times = np.asarray(t_s, dtype=np.float64)
        self.time_s = float(times[-1])
        return times

    def _sideways(self, direction: F, size_urad: tuple[float, float]) -> F:
        """Return a small random vector perpendicular to a unit vector; its length is drawn uniformly within ``size_urad``."""
        across = self._setup.normal(size=3)
        across -= direction * (direction @ across)
        vector: F = across / np.linalg.norm(across) * self._setup.uniform(*size_urad) * URAD
        return vector


ROUNDING_MM = 1e-8


def _first_sign(track_mm: F) -> float:
    moved = np.flatnonzero(np.abs(np.diff(track_mm)) > ROUNDING_MM)
    return float(np.sign(np.diff(track_mm)[moved[0]])) if moved.size else 1.0
