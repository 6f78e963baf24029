"""How well one ball-bar test determines its parameters: condition, correlation, and uncertainty per unit of noise (math.md 4.4, 4.5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from abbe.models.arrays import F1, F2
from abbe.models.papers.yang.simplified import ZConvention, matrix_of
from abbe.models.solvers.designs import unit_columns
from abbe.models.solvers.identifiability import RANK_TOLERANCE


@dataclass(frozen=True)
class Conditioning:
    """Figures of one design.

    Attributes
    ----------
    singular_values : array, shape (p,)
        Of the design with columns of unit length, largest first.
    rank : int
        Singular values above 1e-9 of the largest.
    condition : float
        Largest over the smallest singular value that counts in ``rank``.
    """

    singular_values: F1
    rank: int
    condition: float


@dataclass(frozen=True)
class Spread:
    """Uncertainty of the parameters per mm of reading noise, in their units per mm, and their correlations: shape (p,) and (p, p)."""

    sigma_per_mm: F1
    correlation: F2

    @property
    def largest_correlation(self) -> float:
        """Largest magnitude off the diagonal."""
        return float(np.abs(self.correlation - np.diag(np.diag(self.correlation))).max())


def design_eq9(points_mm: F2, origin_mm: F1, *, setup: bool = True, z_convention: ZConvention = "slide") -> F2:
    """Change of the bar length per unit of the six parameters, and with ``setup`` of cup offset (3) and bar length (1).

    Parameters
    ----------
    points_mm, origin_mm : array, shape (n, 3) and (3,)
        Scales (or, with "workpiece", workpiece coordinates as printed).

    Returns
    -------
    array, shape (n, 6) or (n, 10): mm per unit parameter, workpiece coordinates for the cup offset.
    """
    d = np.asarray(points_mm, dtype=np.float64) - origin_mm
    radius = np.linalg.norm(d, axis=1, keepdims=True)
    six = matrix_of(points_mm, origin_mm, z_convention) / radius
    if not setup:
        return np.asarray(six)
    to_workpiece = np.array([1.0, 1.0, -1.0 if z_convention == "slide" else 1.0])
    return np.concatenate([six, -d * to_workpiece / radius, np.ones((len(d), 1))], axis=1)


def two_radii_design(points_mm: tuple[F2, ...], origin_mm: F1, *, centre_separate: bool, radius_separate: bool) -> F2:
    """Design of ball-bar tests with several bars about one origin: six parameters, then cup offsets, then bar lengths (math.md 4.5).

    Parameters
    ----------
    points_mm : tuple of (n_k, 3) arrays
        One test per bar, scales.
    centre_separate, radius_separate : bool
        Whether each test has its own cup offset (the cup was set anew) and its own bar length error, or all share one.
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
    """Rank and condition of a design, columns of unit length first (math.md 4.4).

    Parameters
    ----------
    a : array, shape (n, p)
        Reading per unit of each parameter (mm per unit, e.g. `design_eq9`); the parameters' units do not matter.

    Returns
    -------
    Conditioning
        Numbers without unit.

    Raises
    ------
    ValueError
        ``a`` is no matrix, not finite, or all zeros: nothing has been observed.
    """
    if np.ndim(a) != 2 or not np.size(a) or not np.isfinite(a).all() or not np.any(a):
        raise ValueError(f"conditioning: the design of shape {np.shape(a)} must be finite and show at least one parameter")
    s = scipy.linalg.svd(unit_columns(a)[0], compute_uv=False)
    rank = int((s > RANK_TOLERANCE * s[0]).sum())
    return Conditioning(s, rank, float(s[0] / s[rank - 1]))


def spread(a: F2) -> Spread:
    """Uncertainty and correlation of least-squares estimates from a design of full rank, white noise assumed (math.md 4.4, 4.5).

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
        The design has not full rank.
    """
    unit, factor = unit_columns(a)
    _, r = scipy.linalg.qr(unit, mode="economic")
    if np.abs(np.diag(r)).min() < RANK_TOLERANCE:
        raise ValueError("the design has not full rank: some combination of its parameters has no finite uncertainty")
    inverse = scipy.linalg.solve_triangular(r, np.eye(a.shape[1])) * factor[:, None]
    covariance = inverse @ inverse.T
    sigma: F1 = np.sqrt(np.diag(covariance))
    return Spread(sigma, np.asarray(covariance / np.outer(sigma, sigma)))


def common_scale_trace_mm(a: F2, radius_mm: float) -> float:
    """Largest reading that a common scale of 1 with a bar shorter by its radius leaves: 0 up to rounding (math.md 4.5, the tenth unknown).

    ``a``: ten columns of `design_eq9`.
    """
    v = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -radius_mm])
    return float(np.abs(a @ v).max())
