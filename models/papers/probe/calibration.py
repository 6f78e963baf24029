"""Effective radius and lobing map of a probe from touches on a master sphere (P (13), section 3.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2
from abbe.models.papers.probe.model import LobingMap, direction, finite_vectors

Indices = NDArray[np.intp]
ROUNDING_RAD = 1e-9
"""Largest difference of equal angles by rounding."""
ABSORBED = ("nx", "ny", "nz", "1")
"""Functions of the touching direction that a sphere fit attributes to centre and radius; a calibrated map does not contain them."""
ITERATIONS = 50
STEP_MM = 1e-14
SINGULAR = 1e-8
EDGE_RAD = 1e-6


def map_of_pattern(directions_rad: F2, values_mm: F1, tolerance_rad: float = ROUNDING_RAD) -> LobingMap:
    """Make a map from values at the directions of a pattern: circles with common longitudes, and one touch at the pole.

    The circles and longitudes of the map are the medians of the touches. The value of a touch is assigned to its node without correction;
    for a lobing of 4 µm with three lobes, an offset of half a degree changes it by up to 0.1 µm.

    Parameters
    ----------
    directions_rad : array, shape (n, 2)
        Colatitude and longitude of each touch; longitudes may exceed one turn.
    values_mm : array, shape (n,)
    tolerance_rad : float
        Largest angle between a touch and its node. The default allows for rounding only; touches of a real machine need e.g.
        ``np.deg2rad(0.5)``. Neighbouring circles and longitudes must be more than four tolerances apart.

    Raises
    ------
    ValueError
        Shapes do not agree, a number is not finite, the tolerance is not between 0 and pi/4, or the directions do not form such a pattern:
        a node or the pole has no touch or more than one.
    """
    angles, values = np.asarray(directions_rad, dtype=np.float64), np.asarray(values_mm, dtype=np.float64)
    if angles.ndim != 2 or angles.shape[1] != 2 or values.shape != angles.shape[:1]:
        raise ValueError(f"lobing map: directions {angles.shape} and values {values.shape} do not fit together, expected (n, 2) and (n,)")
    if not (np.isfinite(angles).all() and np.isfinite(values).all()) or not 0.0 < tolerance_rad < np.pi / 4:
        raise ValueError(f"lobing map: all numbers must be finite, and the tolerance above 0 and below pi/4 rad, got {tolerance_rad:g}")
    pole = np.abs(angles[:, 0]) <= tolerance_rad
    if int(pole.sum()) != 1 or values.size < 2:
        raise ValueError(
            f"lobing map: expected circles and exactly one touch at the pole; {int(pole.sum())} of {values.size} touches are at the pole"
        )
    circle, row = _levels("colatitude", angles[~pole, 0], tolerance_rad)
    # The same distance on the sphere is a larger difference in longitude, the most on the smallest circle.
    wide = tolerance_rad / max(float(np.sin(circle).min()), tolerance_rad)
    longitude, column = _around(angles[~pole, 1], wide)
    _check_complete(circle, longitude, row, column)
    grid = np.empty((circle.size, longitude.size))
    grid[row, column] = values[~pole]
    return LobingMap(circle, longitude, grid, float(values[pole][0]))


def _levels(name: str, angles_rad: F1, tolerance_rad: float) -> tuple[F1, Indices]:
    """Group nearly equal angles; return the median of each group, increasing, and the group index of each angle."""
    order = np.argsort(angles_rad, kind="stable")
    ranked = angles_rad[order]
    level = np.concatenate([[0], np.cumsum(np.diff(ranked) > 2.0 * tolerance_rad)])
    groups = [ranked[level == k] for k in range(int(level[-1]) + 1)]
    wide = next((g for g in groups if g[-1] - g[0] > 2.0 * tolerance_rad * (1.0 + 1e-9)), None)
    if wide is not None:
        span = f"{np.rad2deg(wide[0]):.6g} to {np.rad2deg(wide[-1]):.6g} degrees"
        raise ValueError(f"lobing map: touches of {name} {span} are closer than the tolerance; give a smaller tolerance")
    index = np.empty(angles_rad.size, dtype=np.intp)
    index[order] = level
    return np.array([float(np.median(g)) for g in groups]), index


def _around(longitudes_rad: F1, tolerance_rad: float) -> tuple[F1, Indices]:
    """Group longitudes as `_levels` does; the circle is cut at its largest gap, because a group may lie across zero."""
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
        place = f"colatitude {np.rad2deg(circle[i]):.6g}, longitude {np.rad2deg(longitude[k]):.6g} degrees"
        raise ValueError(
            f"lobing map: expected circles with the same longitudes; {circle.size} circles and {longitude.size} longitudes were found, "
            f"with {count[i, k]} touches at {place}"
        )


def master_sphere_pattern(circles: int = 5, longitudes: int = 20, step_rad: float = np.pi / 10) -> F2:
    """Return touching directions on the upper half of a sphere, from the equator up, the pole last (P section 3.2: 5 x 20 + 1 = 101).

    Parameters
    ----------
    circles : int
        Circles of latitude 0, step, 2 step, ...; they must end below the pole.
    longitudes : int
        Number of equidistant points on each circle.
    step_rad : float
        Distance of the circles; default 18 degrees.

    Returns
    -------
    array, shape (circles * longitudes + 1, 2)
        Colatitude and longitude, rad, in the probe frame.

    Raises
    ------
    ValueError
        There is no circle, there are fewer than three longitudes, or a circle reaches the pole.
    """
    if circles < 1 or longitudes < 3 or not 0.0 < step_rad * max(circles - 1, 1) < np.pi / 2 - EDGE_RAD:
        raise ValueError("sphere pattern: one or more circles below the pole are needed, each with three or more points")
    colatitude = np.pi / 2 - step_rad * np.arange(circles)
    longitude = 2.0 * np.pi * np.arange(longitudes) / longitudes
    grid = np.stack(np.meshgrid(colatitude, longitude, indexing="ij"), axis=-1).reshape(-1, 2)
    return np.vstack([grid, np.zeros((1, 2))])


@dataclass(frozen=True)
class SphereFit:
    """Sphere fitted to points by least squares of their radial distances.

    Parameters
    ----------
    centre_mm : array, shape (3,)
    radius_mm : float
    residual_mm : array, shape (n,)
        Distance from the centre minus radius.
    cofactor : array, shape (4, 4)
        Covariance of centre x, y, z and radius for a standard deviation of 1 of every radial distance: multiply by the variance.
    leverage : array, shape (n,)
        Share of the noise of each distance that the fit absorbs; the sum is 4.
    """

    centre_mm: F1
    radius_mm: float
    residual_mm: F1
    cofactor: F2
    leverage: F1

    @property
    def sigma(self) -> F1:
        """Standard deviations of centre x, y, z and radius per unit of radial noise, shape (4,)."""
        return np.asarray(np.sqrt(np.diag(self.cofactor)))

    @property
    def correlation(self) -> F2:
        """Correlations of centre x, y, z and radius, shape (4, 4); on a hemisphere that of centre z and radius is -0.84."""
        return np.asarray(self.cofactor / np.outer(self.sigma, self.sigma))

    def noise_mm(self) -> float:
        """Return the rms of the residuals with n - 4 degrees of freedom (noise and lobing together); NaN for four points."""
        freedom = self.residual_mm.size - 4
        return float(np.sqrt(self.residual_mm @ self.residual_mm / freedom)) if freedom > 0 else float("nan")


def fit_sphere(points_mm: F2) -> SphereFit:
    """Fit a sphere by least squares of the radial deviations (Gauss-Newton from the algebraic fit).

    Parameters
    ----------
    points_mm : array, shape (n, 3)
        Four or more, not all on one circle.

    Raises
    ------
    ValueError
        Wrong shape, not finite, fewer than four points, or points that leave centre and radius undetermined.
    """
    p = finite_vectors(points_mm)
    if p.ndim != 2 or p.shape[0] < 4:
        raise ValueError(f"sphere fit: four or more points of shape (n, 3) are needed, got shape {p.shape}")
    middle = p.mean(axis=0)
    size = float(np.sqrt(((p - middle) ** 2).sum(axis=1).mean()))
    if size == 0.0:
        raise ValueError("sphere fit: all points coincide")
    q = (p - middle) / size
    design = np.column_stack([2.0 * q, np.ones(len(q))])
    singular = np.linalg.svd(design, compute_uv=False)
    if singular[-1] < SINGULAR * singular[0]:
        raise ValueError("sphere fit: the points lie on one circle or plane and do not determine centre and radius")
    start = np.linalg.lstsq(design, (q * q).sum(axis=1), rcond=None)[0]
    centre = start[:3] * size
    shifted = p - middle
    for _ in range(ITERATIONS):
        way = shifted - centre
        distance = np.linalg.norm(way, axis=1)
        step = np.linalg.lstsq(_columns(way / distance[:, None]), distance - distance.mean(), rcond=None)[0]
        centre = centre + step[:3]
        if np.abs(step[:3]).max() < STEP_MM * max(size, 1.0):
            break
    way = shifted - centre
    distance = np.linalg.norm(way, axis=1)
    columns = _columns(way / distance[:, None])
    cofactor = np.asarray(np.linalg.inv(columns.T @ columns), dtype=np.float64)
    leverage = np.asarray(np.einsum("ni,ij,nj->n", columns, cofactor, columns))
    return SphereFit(centre + middle, float(distance.mean()), distance - distance.mean(), cofactor, leverage)


def _columns(normal: F2) -> F2:
    """Return the regressors of centre and radius: nx, ny, nz, 1."""
    return np.column_stack([normal, np.ones(normal.shape[0])])


def without_absorbed(directions_rad: F2, values_mm: F1) -> F1:
    """Return a lobing without the part that a sphere fit over the same directions absorbs (`ABSORBED`, by least squares).

    Parameters
    ----------
    directions_rad : array, shape (n, 2)
        Colatitude and longitude.
    values_mm : array, shape (n,)

    Returns
    -------
    array, shape (n,): the part of ``values_mm`` that a calibration can find, to first order.
    """
    angles, v = np.asarray(directions_rad, dtype=np.float64), np.asarray(values_mm, dtype=np.float64)
    columns = _columns(direction(angles[:, 0], angles[:, 1]))
    return np.asarray(v - columns @ np.linalg.lstsq(columns, v, rcond=None)[0])


@dataclass(frozen=True)
class ProbeCalibration:
    """Calibration of a probe on a master sphere.

    ``probe_mm`` is the lobing at the touched directions, positive if the reading is too near the centre of the sphere. This lobing lacks
    the four functions `ABSORBED`: parts of the true lobing in nx, ny, nz move the fitted centre, a constant part changes the radius.

    Parameters
    ----------
    fit : SphereFit
        Sphere through the ball centres; its radius is master radius plus effective ball radius.
    effective_radius_mm : float
        Reff, the mean of Rm - Rs, P (13); Rm: distance of a ball centre from the fitted centre, Rs: master radius.
    directions_rad : array, shape (n, 2)
        Colatitudes and longitudes of the touches.
    probe_mm : array, shape (n,)
        Lobing, Reff - (Rm - Rs).
    """

    fit: SphereFit
    effective_radius_mm: float
    directions_rad: F2
    probe_mm: F1

    def uncertainty_mm(self, noise_mm: float) -> tuple[F1, F1]:
        """Return the standard uncertainties of centre x, y, z and effective radius (4,), and of each map value (n,).

        ``noise_mm`` is the standard deviation of the radial noise of one touch; NaN (unknown) gives NaN. A map value is a residual, and its
        variance is the variance of the noise times (1 - leverage).

        Raises
        ------
        ValueError
            The noise is negative or infinite.
        """
        if noise_mm < 0.0 or np.isinf(noise_mm):
            raise ValueError(f"calibration: noise_mm must be finite and not negative, got {noise_mm}")
        return noise_mm * self.fit.sigma, np.asarray(noise_mm * np.sqrt(np.maximum(1.0 - self.fit.leverage, 0.0)))

    def lobing_map(self, tolerance_rad: float = ROUNDING_RAD) -> LobingMap:
        """Return the map, for touches in a pattern like `master_sphere_pattern`; parameter and errors as in `map_of_pattern`."""
        return map_of_pattern(self.directions_rad, self.probe_mm, tolerance_rad)


def calibrate(ball_centres_mm: F2, directions_rad: F2, master_radius_mm: F1 | float) -> ProbeCalibration:
    """Compute effective radius and lobing from ball centres measured at a master sphere (P (13)).

    Parameters
    ----------
    ball_centres_mm : array, shape (n, 3)
        Readings of the ball centres.
    directions_rad : array, shape (n, 2)
        Colatitude and longitude of each touch in the probe frame; the fit does not use them.
    master_radius_mm : float, or array of shape (n,)
        Radius of the master sphere, or its calibrated radius in each direction (Rs(phi, theta)).

    Raises
    ------
    ValueError
        Shapes do not agree, numbers are not finite, the radius is not positive, or the points determine no sphere.
    """
    p, angles = finite_vectors(ball_centres_mm), np.asarray(directions_rad, dtype=np.float64)
    radius = np.asarray(master_radius_mm, dtype=np.float64)
    if p.ndim != 2 or angles.shape != (p.shape[0], 2) or radius.shape not in ((), (p.shape[0],)):
        raise ValueError(f"calibration: centres {p.shape}, directions {angles.shape} and radius {radius.shape} do not fit together")
    if not np.isfinite(angles).all() or not (np.isfinite(radius) & (radius > 0.0)).all():
        raise ValueError("calibration: directions must be finite, and the radius of the master sphere positive")
    fit = fit_sphere(p)
    over = fit.radius_mm + fit.residual_mm - radius
    effective = float(over.mean())
    return ProbeCalibration(fit, effective, angles, effective - over)
