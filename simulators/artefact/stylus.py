"""The touch probe: a ball on a stylus that trips a little after it touches, later in some directions than in others (lobing).

The pre-travel is the travel from the ball's first touch to the trip. In a kinematic probe with three arms it repeats every 120 degrees. The
noise of the trip is the repeatability.
"""

from dataclasses import dataclass

import numpy as np

from abbe.simulators.arrays import F
from abbe.simulators.scenario import ProbeConfig
from abbe.simulators.truth.draws import UM, generator

STREAM_STYLUS, STREAM_TRIPS = 22, 23


@dataclass(slots=True)
class Stylus:
    """The probe in the spindle. ``false_trips``, ``missed``: number of the next touches that trip falsely or not at all (tests);
    ``broken``: whether the probe was driven into the material."""

    radius_mm: float
    pretravel_mm: float
    lobing_mm: float
    phase_rad: float
    noise_mm: float
    rng: np.random.Generator
    false_trips: int = 0
    missed: int = 0
    broken: bool = False

    def trip_depth(self, way: F) -> float:
        """Return the pre-travel, mm, for an approach along the unit vector ``way``."""
        flat = float(np.hypot(way[0], way[1]))
        lobes = self.lobing_mm * flat * np.cos(3.0 * np.arctan2(way[1], way[0]) + self.phase_rad)
        along = self.pretravel_mm * (0.35 + 0.65 * flat)
        return float(along + lobes + self.noise_mm * self.rng.standard_normal())


def draw_stylus(config: ProbeConfig, seed: int) -> Stylus:
    """Draw the probe of a scenario."""
    rng = generator(seed, STREAM_STYLUS)
    return Stylus(
        radius_mm=config.radius_mm,
        pretravel_mm=config.pretravel_um * UM,
        lobing_mm=config.lobing_um * UM,
        phase_rad=float(rng.uniform(0.0, 2.0 * np.pi)),
        noise_mm=config.noise_um * UM,
        rng=generator(seed, STREAM_TRIPS),
    )
