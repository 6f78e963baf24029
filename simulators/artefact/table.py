"""The plate and the qualification sphere on the table, and the probe in the spindle that touches them after mounting by the fixture."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from abbe.simulators.arrays import F
from abbe.simulators.artefact.plate import Mounting, clearance, draw_mounting, draw_plate, placed
from abbe.simulators.scenario import ProbeConfig, Scenario
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


COARSE_MM, FINE_MM = 0.25, 0.01
NEAR_MM = 2.0
"""More than the errors of any simulated machine."""
CRASH_MM = 1.0
"""Depth in the material beyond which the stylus breaks."""
OVERTRAVEL_S = 0.002
"""Time from the trip until the axes stop."""

Tip = Callable[[F], F]
"""Maps fractions (n,) of a straight move, in ascending order, to positions of the stylus tip, (n, 3) mm in workpiece coordinates."""


class PlateUnderProbe:
    """Plate and probe. Nothing is there until `mount`."""

    def __init__(self, scenario: Scenario, tool_mm: F) -> None:
        self._config, self._seed, self._tool_mm = scenario.artefact, scenario.seed, tool_mm
        self.body = draw_plate(scenario.artefact, scenario.seed)
        self.sphere_mm, self.sphere_radius_mm = np.array(scenario.sphere.centre_mm) + tool_mm, scenario.sphere.radius_mm
        """The qualification sphere: centre in workpiece coordinates, and radius; 0: there is none."""
        self.stylus = draw_stylus(scenario.probe, scenario.seed)
        self.quarters = 0
        """Quarter turns by which the next mounting is wrong (tests)."""
        self.temperature_c = 20.0
        self._mounting: Mounting | None = None
        self._count = 0

    @property
    def fitted(self) -> bool:
        """Whether the probe is in the spindle and not broken."""
        return self._mounting is not None and not self.stylus.broken

    def mount(self, origin_mm: F, matrix: F, time_s: float) -> None:
        """Put the plate's zero at the axis position ``origin_mm``, its axes along the columns of ``matrix``, and fit the probe."""
        self._count += 1
        self.stylus.broken = False
        origin = origin_mm + self._tool_mm
        if self.quarters:
            origin, matrix = self._turned(origin, matrix)
        self._mounting = draw_mounting(self._config, self._seed, self._count, (origin, matrix), time_s)

    def unmount(self) -> None:
        """Take plate and probe away."""
        self._mounting = None

    def move(self, by_mm: F) -> None:
        """Let the plate slip (tests)."""
        if self._mounting is not None:
            self._mounting = replace(self._mounting, origin_mm=self._mounting.origin_mm + by_mm)

    def deflected(self, tip_mm: F, time_s: float) -> bool:
        """Whether the stylus is pushed aside at a place of its tip (3,)."""
        return bool(self.fitted and self._free(tip_mm[None, :], time_s)[0] < -0.5 * self.stylus.pretravel_mm)

    def near(self, tip_mm: F, time_s: float) -> bool:
        """Whether the stylus may touch something if its tip is within `NEAR_MM` of a place (3,)."""
        return bool(self._free(tip_mm[None, :], time_s)[0] < NEAR_MM)

    def contact(self, length_mm: float, way: F, tip: Tip, time_s: float) -> float | None:
        """Return the length of a straight move, mm, after which the probe trips; None if never. ``way``: unit vector of the move."""
        if not self.fitted:
            return None
        if self.stylus.false_trips:
            self.stylus.false_trips -= 1
            return float(self.stylus.rng.uniform(0.2, 0.8)) * length_mm
        found = self._first_below(-self.stylus.trip_depth(way), length_mm, tip, time_s)
        if found is not None and self.stylus.missed:
            self.stylus.missed -= 1
            return None
        return found

    def crash(self, length_mm: float, tip: Tip, time_s: float) -> float | None:
        """Return the length of a straight move, mm, after which the stylus breaks; None if it does not break."""
        return self._first_below(-CRASH_MM, length_mm, tip, time_s) if self.fitted else None

    def _first_below(self, level_mm: float, length_mm: float, tip: Tip, time_s: float) -> float | None:
        """Return the length of a move, mm, after which the clearance first falls below a level (coarse grid, then a fine one near it)."""
        coarse = np.linspace(0.0, 1.0, max(2, int(np.ceil(length_mm / COARSE_MM)) + 1))
        free = self._free(tip(coarse), time_s)
        if free[0] < level_mm:
            return None if free[-1] > free[0] else 0.0  # it backs out
        near = np.flatnonzero(np.minimum(free[:-1], free[1:]) < level_mm + COARSE_MM)
        for k in near:
            fine = np.linspace(coarse[k], coarse[k + 1], int(COARSE_MM / FINE_MM) + 1)
            shares = np.concatenate([coarse[:k], fine])
            values = self._free(tip(shares), time_s)[k:] - level_mm
            below = np.flatnonzero(values < 0.0)
            if below.size:
                i = int(below[0])
                share = fine[i] if i == 0 else fine[i - 1] + (fine[i] - fine[i - 1]) * values[i - 1] / (values[i - 1] - values[i])
                return float(share) * length_mm
        return None

    def _free(self, tip_mm: F, time_s: float) -> F:
        assert self._mounting is not None
        centres = placed(self.body, self._mounting, time_s, self.temperature_c)
        free = clearance(self.body, self._mounting, centres, tip_mm, self.stylus.radius_mm)
        if not self.sphere_radius_mm:
            return free
        to_sphere: F = np.linalg.norm(tip_mm - self.sphere_mm, axis=1) - self.sphere_radius_mm - self.stylus.radius_mm
        return np.minimum(free, to_sphere)

    def _turned(self, origin_mm: F, matrix: F) -> tuple[F, F]:
        """Turn the plate about its own centre."""
        middle = self.body.nominal_mm.mean(axis=0)
        quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        turn = np.linalg.matrix_power(quarter, self.quarters)
        return origin_mm + matrix @ (middle - turn @ middle), matrix @ turn
