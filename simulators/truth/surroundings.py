"""Changes with time: thermal drift of the machine, and the air in which the laser measures."""

from dataclasses import dataclass

import numpy as np

from abbe.simulators.arrays import F
from abbe.simulators.truth.draws import STREAM_AIR, Draws, generator


def drift(draws: Draws, time_s: F) -> F:
    """Return the thermal displacement of the tool relative to the workpiece at n times since power-on: (n,) s gives (n, 3) mm."""
    growth = -np.expm1(-time_s / draws.drift_tau_s)
    moved: F = growth[:, None] * draws.drift_mm
    return moved


@dataclass(frozen=True, slots=True)
class AirState:
    """Air at one moment; ``refractivity`` is n - 1."""

    temperature_c: float
    pressure_pa: float
    humidity_percent: float
    refractivity: float


class Air:
    """Slowly varying workshop air."""

    def __init__(self, seed: int) -> None:
        rng = generator(seed, STREAM_AIR)
        self._middle = np.array([20.0, 101325.0, 45.0]) + np.array([0.8, 900.0, 6.0]) * rng.uniform(-1.0, 1.0, 3)
        self._swing = np.array([0.4, 120.0, 3.0])
        self._period_s = 60.0 * rng.uniform(20.0, 90.0, 3)
        self._phase = rng.uniform(0.0, 2.0 * np.pi, 3)
        self.warmer_c = 0.0
        """K, added to the temperature, e.g. after the shop gate was opened."""

    def at(self, time_s: float) -> AirState:
        """Return the state of the air; refractivity by the shop-floor form of the Edlén equation (NIST, engineering metrology toolbox)."""
        angle = 2.0 * np.pi * time_s / self._period_s + self._phase
        temperature, pressure, humidity = (float(v) for v in self._middle + self._swing * np.sin(angle))
        temperature += self.warmer_c
        dry = 7.86e-4 * (pressure / 1000.0) / (273.0 + temperature)
        wet = 1.5e-11 * humidity * (temperature * temperature + 160.0)
        return AirState(temperature, pressure, humidity, dry - wet)
