"""ISO 230-4: circular tests. Circular deviation G, bidirectional G(b), radial deviation F and hysteresis H of a plane.

The deviation of a ball-bar's length around a circle is c + a cos + b sin + the machine's deviation; a and b are the centring error of the
set-up. G refers to the least squares circle of its path, G(b) and H to the least squares circle common to both paths. F is given about the
set-up's centre and about the least squares centre, G also by the minimum zone (two concentric circles as close as possible).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from abbe.models.arrays import F1, F2
from abbe.models.solvers.observations import reading_noise_mm

BINS = 360
"""Sectors of the circle, one degree each, whose means compare the two paths."""
FULL_RAD = np.deg2rad(350.0)
"""A path that covers less is an arc (`OnePath.is_whole`), and its least squares centre is less certain."""
ZONE_POINTS = 2000
"""Largest number of readings for the minimum zone. A longer path is cut into `ZONE_POINTS` / 2 stretches; their highest and lowest
readings are used."""


@dataclass(frozen=True, slots=True)
class CircularTest:
    """One path around a circle: angle from the plane's first axis to its second, rad, and length minus nominal radius, mm, shape (n,)."""

    angle_rad: F1
    deviation_mm: F1

    def __post_init__(self) -> None:
        """Check shapes and numbers.

        Raises
        ------
        ValueError
            Unequal shapes, fewer than 8 readings, or numbers that are not finite.
        """
        if self.angle_rad.shape != self.deviation_mm.shape or self.angle_rad.ndim != 1 or self.angle_rad.size < 8:
            raise ValueError(
                f"ISO 230-4: angles of shape {self.angle_rad.shape} and deviations of shape {self.deviation_mm.shape}; "
                "a circle needs eight or more deviations, each with its angle"
            )
        if not (np.isfinite(self.angle_rad).all() and np.isfinite(self.deviation_mm).all()):
            raise ValueError("ISO 230-4: angles and deviations must be finite numbers")


@dataclass(frozen=True, slots=True)
class OnePath:
    """Figures of one path, mm.

    ``G_mm``, ``G_zone_mm``: G by least squares; by the minimum zone, NaN if the search fails. ``centre_mm``: least squares centre minus the
    set-up's centre; ``radius_mm``: least squares radius minus the nominal one. ``F_max_mm``, ``F_min_mm``: extremes of the radial deviation
    about the set-up's centre; ``..._centred_mm``: about the least squares centre. ``noise_mm``: standard deviation of one reading.
    """

    G_mm: float
    G_zone_mm: float
    F_max_mm: float
    F_min_mm: float
    F_max_centred_mm: float
    F_min_centred_mm: float
    centre_mm: tuple[float, float]
    radius_mm: float
    covered_rad: float
    noise_mm: float

    @property
    def is_whole(self) -> bool:
        """Whether the path covers at least `FULL_RAD`."""
        return bool(self.covered_rad >= FULL_RAD)


@dataclass(frozen=True, slots=True)
class BothWays:
    """Figures of two paths around the same circle, one each way, mm; ``at_rad``: where the hysteresis is largest."""

    G_b_mm: float
    H_mm: float
    at_rad: float


def circular(path: CircularTest) -> OnePath:
    """Evaluate one path."""
    centre, left = _centred([path])
    radius = centre[2]
    return OnePath(
        G_mm=float(np.ptp(left[0])),
        G_zone_mm=zone_mm(path),
        F_max_mm=float(path.deviation_mm.max()),
        F_min_mm=float(path.deviation_mm.min()),
        F_max_centred_mm=float(left[0].max() + radius),
        F_min_centred_mm=float(left[0].min() + radius),
        centre_mm=(float(centre[0]), float(centre[1])),
        radius_mm=float(radius),
        covered_rad=float(np.ptp(np.unwrap(path.angle_rad))),
        noise_mm=reading_noise_mm(path.deviation_mm),
    )


def both_ways(forward: CircularTest, backward: CircularTest) -> BothWays:
    """Evaluate two paths of one set-up, about their common least squares centre.

    H is the largest difference between the paths' mean readings in the same degree, where both have readings.

    Raises
    ------
    ValueError
        The two paths share no angle.
    """
    _, left = _centred([forward, backward])
    means = [_by_degree(c.angle_rad, v) for c, v in zip((forward, backward), left, strict=True)]
    apart = np.abs(means[0] - means[1])
    if not np.isfinite(apart).any():
        raise ValueError("ISO 230-4: the two paths share no angle")
    k = int(np.nanargmax(apart))
    both = np.concatenate(left)
    return BothWays(float(np.ptp(both)), float(apart[k]), float((k + 0.5) * 2.0 * np.pi / BINS))


def centred(path: CircularTest) -> F1:
    """Radial deviation about the least squares circle, mm, shape (n,), for a polar plot."""
    return _centred([path])[1][0]


def _columns(angle_rad: F1) -> F2:
    return np.column_stack([np.cos(angle_rad), np.sin(angle_rad), np.ones(angle_rad.size)])


def _centred(paths: list[CircularTest]) -> tuple[F1, list[F1]]:
    """Common least squares circle (a, b, c) of the paths, and the residuals of each path, mm."""
    a = _columns(np.concatenate([p.angle_rad for p in paths]))
    found = np.linalg.lstsq(a, np.concatenate([p.deviation_mm for p in paths]), rcond=None)[0]
    return found, [np.asarray(p.deviation_mm - _columns(p.angle_rad) @ found) for p in paths]


def zone_mm(path: CircularTest) -> float:
    """Width of the minimum zone, mm: smallest radius difference of two concentric circles that enclose all readings; NaN if not found."""
    left = centred(path)
    keep = _extremes(left)
    a, y = _columns(path.angle_rad[keep]), left[keep]
    scale = float(np.ptp(y)) or 1.0
    inside = np.column_stack([a[:, :2], np.zeros(y.size), np.ones(y.size)])  # a cos + b sin + low <= y
    outside = np.column_stack([-a[:, :2], -np.ones(y.size), np.zeros(y.size)])  # y <= a cos + b sin + high
    found = scipy.optimize.linprog(
        [0.0, 0.0, 1.0, -1.0],
        A_ub=np.concatenate([inside, outside]),
        b_ub=np.concatenate([y, -y]) / scale,
        bounds=[(None, None)] * 4,
        method="highs",
    )
    return float(found.fun) * scale if found.status == 0 else float("nan")


def _extremes(y: F1) -> np.ndarray[tuple[int, ...], np.dtype[np.intp]]:
    if y.size <= ZONE_POINTS:
        return np.arange(y.size)
    parts = np.array_split(np.arange(y.size), ZONE_POINTS // 2)
    return np.unique([[p[np.argmin(y[p])], p[np.argmax(y[p])]] for p in parts])


def _by_degree(angle_rad: F1, values: F1) -> F1:
    place = np.floor(np.mod(angle_rad, 2.0 * np.pi) / (2.0 * np.pi) * BINS).astype(np.int64) % BINS
    count = np.bincount(place, minlength=BINS)
    total = np.bincount(place, weights=values, minlength=BINS)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
