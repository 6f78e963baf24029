"""From touches on circles to a lobing map, where rounding or a real machine puts each touch a little beside its place (math.md 7)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2
from abbe.models.papers.probe.lobing import LobingMap

Indices = NDArray[np.intp]
ROUNDING_RAD = 1e-9
"""Touches that should have the same angle differ by this much or less when only rounding parted them."""


def map_of_pattern(directions_rad: F2, values_mm: F1, tolerance_rad: float = ROUNDING_RAD) -> LobingMap:
    """Map from values at the directions of a pattern: circles that share their longitudes, and one touch at the pole.

    Touches are sorted into circles and longitudes; a node lies at the median of its touches. Each touch's value is moved to its node:
    half a degree changes a lobing of 4 µm in three waves by up to 0.1 µm.

    Parameters
    ----------
    directions_rad : array, shape (n, 2)
        Colatitude and longitude of each touch, longitudes of any turn.
    values_mm : array, shape (n,)
    tolerance_rad : float
        How far a touch may be from its place, as an angle of its direction. The default allows for rounding only; touches of a real
        machine need e.g. ``np.deg2rad(0.5)``. Neighbouring circles and longitudes must be more than four tolerances apart.

    Raises
    ------
    ValueError
        Shapes do not agree, a number is not finite, the tolerance is not positive, or the directions form no such pattern: no touch or
        two at the pole, a place without touch or with two.
    """
    angles, values = np.asarray(directions_rad, dtype=np.float64), np.asarray(values_mm, dtype=np.float64)
    if angles.ndim != 2 or angles.shape[1] != 2 or values.shape != angles.shape[:1]:
        raise ValueError(f"lobing map: directions {angles.shape} and values {values.shape} do not fit together")
    if not (np.isfinite(angles).all() and np.isfinite(values).all()) or not 0.0 < tolerance_rad < np.pi / 4:
        raise ValueError("lobing map: all numbers must be finite and the tolerance positive")
    pole = np.abs(angles[:, 0]) <= tolerance_rad
    if int(pole.sum()) != 1 or values.size < 2:
        raise ValueError(f"lobing map: it takes circles and exactly one touch at the pole, got {int(pole.sum())} of {values.size} there")
    circle, row = _levels("colatitude", angles[~pole, 0], tolerance_rad)
    # The same way on the sphere is a longer one in longitude, most on the smallest circle.
    wide = tolerance_rad / max(float(np.sin(circle).min()), tolerance_rad)
    longitude, column = _around(angles[~pole, 1], wide)
    _check_complete(circle, longitude, row, column)
    grid = np.empty((circle.size, longitude.size))
    grid[row, column] = values[~pole]
    return LobingMap(circle, longitude, grid, float(values[pole][0]))


def _levels(name: str, angles_rad: F1, tolerance_rad: float) -> tuple[F1, Indices]:
    """Different angles, increasing, and which of them each given angle is."""
    order = np.argsort(angles_rad, kind="stable")
    ranked = angles_rad[order]
    level = np.concatenate([[0], np.cumsum(np.diff(ranked) > 2.0 * tolerance_rad)])
    groups = [ranked[level == k] for k in range(int(level[-1]) + 1)]
    wide = next((g for g in groups if g[-1] - g[0] > 2.0 * tolerance_rad * (1.0 + 1e-9)), None)
    if wide is not None:
        span = f"{np.rad2deg(wide[0]):.6g} to {np.rad2deg(wide[-1]):.6g} degrees"
        raise ValueError(f"lobing map: touches at every {name} from {span} cannot be told apart with this tolerance")
    index = np.empty(angles_rad.size, dtype=np.intp)
    index[order] = level
    return np.array([float(np.median(g)) for g in groups]), index


def _around(longitudes_rad: F1, tolerance_rad: float) -> tuple[F1, Indices]:
    """As `_levels` for angles that go round: where a longitude lies across zero, the turn is cut at its largest gap instead."""
    slack, turn = 2.0 * tolerance_rad, np.mod(longitudes_rad, 2.0 * np.pi)
    ranked = np.sort(turn)
    gaps = np.diff(ranked, append=ranked[0] + 2.0 * np.pi)
    if gaps[-1] > slack:
        return _levels("longitude", turn, tolerance_rad)
    found, index = _levels("longitude", np.where(turn > ranked[np.argmax(gaps)], turn - 2.0 * np.pi, turn), tolerance_rad)
    nodes = np.where(found < -slack, found + 2.0 * np.pi, found)
    order = np.argsort(nodes)
    return nodes[order], np.argsort(order)[index]


def _check_complete(circle: F1, longitude: F1, row: Indices, column: Indices) -> None:
    count = np.zeros((circle.size, longitude.size), dtype=np.intp)
    np.add.at(count, (row, column), 1)
    if (count != 1).any():
        i, k = (int(n) for n in np.argwhere(count != 1)[0])
        where = f"colatitude {np.rad2deg(circle[i]):.6g}, longitude {np.rad2deg(longitude[k]):.6g} degrees"
        raise ValueError(
            f"lobing map: it takes circles with the same longitudes; {circle.size} circles and {longitude.size} longitudes were found, "
            f"with {count[i, k]} touches at {where}"
        )
