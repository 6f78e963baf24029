"""Yang and Kim's six-parameter model and its fit, (2) and (9), and the conditioning of its parameters in one ball-bar test.

Erratum: (2), (4), (8), (9) use the z of the slide as a workpiece coordinate, but by (1) the workpiece coordinate is -z. With readings of a
real machine the printed matrix gives dzz, Sxz and Syz the wrong sign. The default here (``z_convention="slide"``) is correct.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import Literal

import numpy as np
import scipy

from abbe.models.arrays import F1, F2
from abbe.models.solvers.least_squares import RANK_TOLERANCE, unit_columns

RADIUS_TOLERANCE = 0.01
"""Largest relative difference of radius and distance from the origin; if it is larger, radius or origin belong to other points."""
ZConvention = Literal["slide", "workpiece"]
PRINTED_WARNING = (
    "z was used as a workpiece coordinate, as in (2), (4), (8) and (9) of the paper: if it is the position of the Z slide, "
    "dzz, Sxz and Syz come out with the wrong sign"
)


@dataclass(frozen=True, slots=True)
class SixParameters:
    """The six parameters: dxx, dyy, dzz are scale errors (mm/mm); sxy, sxz, syz are squareness (rad), signs of the paper."""

    dxx: float
    dyy: float
    dzz: float
    sxy: float
    sxz: float
    syz: float

    def array(self) -> F1:
        """Return the six values in the paper's order, shape (6,)."""
        return np.array(astuple(self))


@dataclass(frozen=True, slots=True)
class SixFit:
    """Solution of (9), its covariance per mm² of reading variance, residuals, and warnings."""

    parameters: SixParameters
    covariance_per_mm2: F2
    residual_mm: F1
    warnings: tuple[str, ...]


def delta_eq2(p: SixParameters, slide_mm: F2) -> F2:
    """Return the error of the six-parameter model, (2), shape (n, 3), mm; ``slide_mm``: scales x, y, z (z of the cross slide)."""
    x, y, z = np.asarray(slide_mm, dtype=np.float64).T
    return np.stack([p.dxx * x - y * p.sxy, p.dyy * y, -p.dzz * z - x * p.sxz - y * p.syz], axis=1)


def matrix_eq9_printed(points_mm: F2, origin_mm: F1) -> F2:
    """Return matrix A of (9) as printed, with z as a workpiece coordinate (erratum), shape (n, 6), mm²."""
    u, v, s = (np.asarray(points_mm, dtype=np.float64) - origin_mm).T
    return np.stack([u * u, v * v, -s * s, -u * v, -u * s, -v * s], axis=1)


def matrix_eq9(points_mm: F2, origin_mm: F1) -> F2:
    """Return matrix A of (9) for scale readings, with -z as the workpiece coordinate, shape (n, 6), mm²."""
    u, v, s = (np.asarray(points_mm, dtype=np.float64) - origin_mm).T
    return np.stack([u * u, v * v, s * s, -u * v, u * s, v * s], axis=1)


def matrix_of(points_mm: F2, origin_mm: F1, z_convention: ZConvention) -> F2:
    """Return `matrix_eq9` for ``"slide"``, `matrix_eq9_printed` for ``"workpiece"``; any other convention raises ValueError."""
    if z_convention not in ("slide", "workpiece"):
        raise ValueError(f"z_convention {z_convention!r}: must be 'slide' or 'workpiece'")
    return matrix_eq9(points_mm, origin_mm) if z_convention == "slide" else matrix_eq9_printed(points_mm, origin_mm)


def fit_eq9(points_mm: F2, origin_mm: F1, delta_r_mm: F1, radius_mm: float, *, z_convention: ZConvention = "slide") -> SixFit:
    """Fit the six parameters to one ball-bar test by least squares, (9), assuming a perfect set-up.

    A mounting error of 10 µm causes errors of about 100 µrad. For measured data use `abbe.models.solvers.helix.fit_helix`, which fits cup
    offset and bar length too.

    Parameters
    ----------
    points_mm, origin_mm : array, shape (n, 3) and (3,)
        Commanded positions and centre, as scales or workpiece coordinates according to ``z_convention``.
    delta_r_mm : array, shape (n,)
        Bar length minus radius.
    radius_mm : float
        Nominal bar length: the distance of the points from the origin, to 1 %.
    z_convention : "slide" | "workpiece"
        ``slide``: z is the position of the Z slide. ``workpiece``: as printed, with a warning in the result.

    Returns
    -------
    SixFit
        Parameters in mm/mm and rad (signs of the paper: obtuse positive), covariance per mm² of reading variance, residuals (mm), warnings.

    Raises
    ------
    ValueError
        ``z_convention`` is unknown, the readings are fewer than six or do not determine the six parameters, or the radius is not positive
        or differs by more than 1 % from the distance of the points from the origin.
    """
    if not 0 < radius_mm < np.inf:
        raise ValueError(f"eq (9): radius {radius_mm} mm must be positive")
    a = matrix_of(points_mm, origin_mm, z_convention) / radius_mm
    if len(delta_r_mm) < 6 or a.shape[0] != len(delta_r_mm):
        raise ValueError(
            f"eq (9): {len(delta_r_mm)} readings for {a.shape[0]} points; one for each is needed, and six or more for the six parameters"
        )
    away = np.linalg.norm(np.asarray(points_mm, dtype=np.float64) - origin_mm, axis=1)
    worst = float(away[int(np.argmax(np.abs(away - radius_mm)))])
    if not abs(worst - radius_mm) <= RADIUS_TOLERANCE * radius_mm:
        raise ValueError(f"eq (9): a point lies {worst:g} mm from the origin, but the radius is {radius_mm:g} mm")
    scale = np.linalg.norm(a, axis=0)
    if not (scale > 0).all():
        raise ValueError("eq (9): at every point at least one coordinate from the centre is zero, so some parameters are not determined")
    q, r = scipy.linalg.qr(a / scale, mode="economic")
    if np.abs(np.diag(r)).min() < 1e-9:
        raise ValueError("eq (9): the points do not determine the six parameters")
    x = scipy.linalg.solve_triangular(r, q.T @ delta_r_mm) / scale
    inverse = scipy.linalg.solve_triangular(r, np.eye(6)) / scale[:, None]
    warnings = (PRINTED_WARNING,) if z_convention == "workpiece" else ()
    return SixFit(SixParameters(*(float(v) for v in x)), inverse @ inverse.T, np.asarray(delta_r_mm - a @ x), warnings)


@dataclass(frozen=True)
class Conditioning:
    """Conditioning of a design matrix.

    Attributes
    ----------
    singular_values : array, shape (p,)
        Singular values of the design with columns of unit length, largest first.
    rank : int
        Number of singular values above 1e-9 of the largest.
    condition : float
        Largest over the smallest singular value that counts in ``rank``.
    """

    singular_values: F1
    rank: int
    condition: float


@dataclass(frozen=True)
class Spread:
    """Standard uncertainty of the parameters per mm of reading noise, shape (p,), and their correlations, shape (p, p)."""

    sigma_per_mm: F1
    correlation: F2

    @property
    def largest_correlation(self) -> float:
        """Largest absolute correlation of two parameters."""
        return float(np.abs(self.correlation - np.diag(np.diag(self.correlation))).max())


def design_eq9(points_mm: F2, origin_mm: F1, *, setup: bool = True, z_convention: ZConvention = "slide") -> F2:
    """Return the change of the bar length per unit of the six parameters and, with ``setup``, of cup offset (3) and bar length (1).

    Parameters
    ----------
    points_mm, origin_mm : array, shape (n, 3) and (3,)
        Scales or, with ``z_convention`` "workpiece", workpiece coordinates.

    Returns
    -------
    array, shape (n, 6) or (n, 10): mm per unit of the parameter; the cup offset is in workpiece coordinates.
    """
    d = np.asarray(points_mm, dtype=np.float64) - origin_mm
    radius = np.linalg.norm(d, axis=1, keepdims=True)
    six = matrix_of(points_mm, origin_mm, z_convention) / radius
    if not setup:
        return np.asarray(six)
    to_workpiece = np.array([1.0, 1.0, -1.0 if z_convention == "slide" else 1.0])
    return np.concatenate([six, -d * to_workpiece / radius, np.ones((len(d), 1))], axis=1)


def two_radii_design(points_mm: tuple[F2, ...], origin_mm: F1, *, centre_separate: bool, radius_separate: bool) -> F2:
    """Return the design of ball-bar tests with several bars about one origin: six parameters, then cup offsets, then bar lengths.

    Parameters
    ----------
    points_mm : tuple of (n_k, 3) arrays
        Points of one test per bar, as scales.
    centre_separate, radius_separate : bool
        Whether each test has its own cup offset (the cup was set again), and its own bar length error.
    """
    rows = []
    for k, points in enumerate(points_mm):
        a = design_eq9(points, origin_mm)
        own = np.zeros((1, len(points_mm)))
        own[0, k] = 1.0
        centre = np.kron(own if centre_separate else np.ones((1, 1)), a[:, 6:9])
        length = np.kron(own if radius_separate else np.ones((1, 1)), a[:, 9:])
        rows.append(np.concatenate([a[:, :6], centre, length], axis=1))
    return np.concatenate(rows)


def conditioning(a: F2) -> Conditioning:
    """Return rank and condition of a design after scaling its columns to unit length.

    Parameters
    ----------
    a : array, shape (n, p)
        Reading per unit of each parameter (mm per unit, e.g. `design_eq9`); the parameters' units do not matter.

    Returns
    -------
    Conditioning

    Raises
    ------
    ValueError
        ``a`` is not a matrix, is not finite, or is all zeros.
    """
    if np.ndim(a) != 2 or not np.size(a) or not np.isfinite(a).all() or not np.any(a):
        raise ValueError(f"conditioning: the design of shape {np.shape(a)} must be a finite matrix with a number other than 0")
    s = scipy.linalg.svd(unit_columns(a)[0], compute_uv=False)
    rank = int((s > RANK_TOLERANCE * s[0]).sum())
    return Conditioning(s, rank, float(s[0] / s[rank - 1]))


def spread(a: F2) -> Spread:
    """Return uncertainty and correlation of least-squares estimates from a design of full rank, for white noise.

    Parameters
    ----------
    a : array, shape (n, p)
        Reading in mm per unit of each parameter.

    Returns
    -------
    Spread
        Standard uncertainties in units of the parameters per mm of reading noise, shape (p,), and correlations, shape (p, p).

    Raises
    ------
    ValueError
        The design does not have full rank.
    """
    unit, factor = unit_columns(a)
    _, r = scipy.linalg.qr(unit, mode="economic")
    if np.abs(np.diag(r)).min() < RANK_TOLERANCE:
        raise ValueError("spread: the design does not have full rank, so some combination of its parameters has no finite uncertainty")
    inverse = scipy.linalg.solve_triangular(r, np.eye(a.shape[1])) * factor[:, None]
    covariance = inverse @ inverse.T
    sigma: F1 = np.sqrt(np.diag(covariance))
    return Spread(sigma, np.asarray(covariance / np.outer(sigma, sigma)))


def common_scale_trace_mm(a: F2, radius_mm: float) -> float:
    """Return the largest reading that a common scale error of 1 and a bar length error of minus the radius cause together: 0 except for
    rounding.

    One ball-bar cannot separate the two. ``a``: the ten columns of `design_eq9`.
    """
    v = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -radius_mm])
    return float(np.abs(a @ v).max())
