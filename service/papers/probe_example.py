"""A probe like the one of Pahk 3.2 with an assumed lobing, because the paper's map is not available."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.papers.probe.calibration import ProbeCalibration, calibrate, master_sphere_pattern, without_absorbed
from abbe.models.papers.probe.frame import direction
from abbe.service.papers import pahk_printed as paper

THREE_LOBES_MM, POLE_MM = 0.005, 0.0025
EXAMPLE = "5 µm · sin²φ cos 3θ + 2.5 µm · cos 2φ, less what centre and radius of a sphere absorb"


@dataclass(frozen=True, slots=True, eq=False)
class Example:
    """The calibrated example, and the largest deviation of its map from the assumed lobing, mm."""

    calibration: ProbeCalibration
    largest_mm: float

    def values_um(self, colatitude_rad: F1, longitude_rad: F1) -> F2:
        """The map on a grid, shape (colatitudes, longitudes), um."""
        grid = np.meshgrid(colatitude_rad, longitude_rad, indexing="ij")
        return np.asarray(1e3 * self.calibration.lobing_map().at_angles(*grid))


def pattern() -> F2:
    """Directions of the printed pattern: circles and points every 18 degrees, and the pole; shape (101, 2)."""
    step = paper.PATTERN_STEP_DEG.value
    return master_sphere_pattern(round(90.0 / step), round(360.0 / step), float(np.deg2rad(step)))


def example_lobing_mm(directions_rad: F2) -> F1:
    """The assumed lobing: the three lobes of a kinematic touch-trigger probe, and a difference between pole and equator."""
    phi, theta = directions_rad.T
    return without_absorbed(directions_rad, THREE_LOBES_MM * np.sin(phi) ** 2 * np.cos(3.0 * theta) + POLE_MM * np.cos(2.0 * phi))


def example() -> Example:
    """Calibrate a probe with the assumed lobing on the printed master sphere with the printed ball and pattern."""
    angles = pattern()
    normal = direction(angles[:, 0], angles[:, 1])
    lobing = example_lobing_mm(angles)
    distance = paper.SPHERE_MM.value + paper.EFFECTIVE_MM.value - lobing
    found = calibrate(normal * distance[:, None], angles, paper.SPHERE_MM.value)
    return Example(found, float(np.abs(found.probe_mm - lobing).max()))
