"""Weighted linear least squares with an explicit prior, full covariance, and what the data alone can tell.

The prior is part of the statement, never hidden: `ParameterEstimate.data_share` says for every parameter how much of its information came
from the data. Parameters that live on the prior alone are named by `abbe.models.solvers.identifiability`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from abbe.models.arrays import F1, F2


def svd(a: F2, *, full_matrices: bool = False) -> tuple[F2, F1, F2]:
    """Singular value decomposition a = u @ diag(s) @ vt.

    Divide and conquer (gesdd) is several times faster and fails on some matrices of exactly dependent columns, whose rounding decides; then
    QR iteration (gesvd) does it, whose convergence does not depend on rounding.

    Raises
    ------
    ValueError
        Something in the matrix is no finite number.
    """
    try:
        u, s, vt = scipy.linalg.svd(a, full_matrices=full_matrices, check_finite=False)
    except scipy.linalg.LinAlgError:
        u, s, vt = scipy.linalg.svd(a, full_matrices=full_matrices, lapack_driver="gesvd")
    return np.asarray(u), np.asarray(s), np.asarray(vt)


def singular_values(a: F2) -> F1:
    """Singular values alone, largest first; raises as `svd`."""
    try:
        return np.asarray(scipy.linalg.svd(a, compute_uv=False, check_finite=False))
    except scipy.linalg.LinAlgError:
        return np.asarray(scipy.linalg.svd(a, compute_uv=False, lapack_driver="gesvd"))


@dataclass(frozen=True)
class ParameterEstimate:
    """Solution of one linear problem.

    Attributes
    ----------
    names : tuple of str
    theta : array, shape (p,)
    covariance : array, shape (p, p)
        Posterior covariance, scaled by ``variance_factor`` where the residuals are larger than the stated noise.
    residual : array, shape (n,)
        Observed minus predicted, in the unit of the observations.
    chi2, dof : float
        Sum of squared whitened residuals; observations minus effective number of parameters.
    variance_factor : float
        max(1, chi2 / dof): a fit worse than the stated noise widens every uncertainty, a better one does not shrink it.
    data_share : array, shape (p,)
        1 - posterior variance / prior variance (before scaling), between 0 (prior only) and 1 (data only).
    """

    names: tuple[str, ...]
    theta: F1
    covariance: F2
    residual: F1
    chi2: float
    dof: float
    variance_factor: float
    data_share: F1

    def value(self, name: str) -> float:
        """Estimate of a parameter by name."""
        return float(self.theta[self.names.index(name)])

    def u(self, name: str) -> float:
        """Standard uncertainty of a parameter by name."""
        i = self.names.index(name)
        return float(np.sqrt(self.covariance[i, i]))


def solve_map(names: tuple[str, ...], a: F2, y: F1, sigma: F1, prior_sd: F1) -> ParameterEstimate:
    """Most probable parameters of ``y = a @ theta + noise`` with independent zero-mean normal priors.

    Parameters
    ----------
    a : array, shape (n, p)
    y, sigma : arrays, shape (n,)
        Observations and their standard uncertainty.
    prior_sd : array, shape (p,)
        Prior standard deviation; ``inf`` for none.

    Raises
    ------
    ValueError
        Shapes disagree, a value is not finite, or a sigma is not positive.
    """
    _check(names, a, y, sigma, prior_sd)
    w = 1.0 / sigma
    known = np.isfinite(prior_sd)
    scale = np.where(known, prior_sd, _column_scale(a))
    ridge = np.where(known, 1.0, 0.0)
    x, cov = _solve_whitened(names, a * scale * w[:, None], y * w, ridge)
    residual = y - a @ (x * scale)
    share = np.where(known, 1.0 - np.diag(cov), 1.0)
    effective = float(len(names) - (np.diag(cov) * ridge).sum())
    chi2 = float(((residual * w) ** 2).sum())
    dof = max(float(y.size) - effective, 1.0)
    factor = max(1.0, chi2 / dof)
    return ParameterEstimate(names, x * scale, cov * np.outer(scale, scale) * factor, residual, chi2, dof, factor, np.clip(share, 0.0, 1.0))


def _check(names: tuple[str, ...], a: F2, y: F1, sigma: F1, prior_sd: F1) -> None:
    if a.shape != (y.size, len(names)) or sigma.shape != y.shape or prior_sd.shape != (len(names),):
        raise ValueError(f"least squares: design {a.shape}, observations {y.shape}, names {len(names)} do not fit together")
    if not (np.isfinite(a).all() and np.isfinite(y).all() and (sigma > 0).all()):
        raise ValueError("least squares: design and observations must be finite and every sigma positive")


def _solve_whitened(names: tuple[str, ...], b: F2, z: F1, ridge: F1) -> tuple[F1, F2]:
    """Minimum of |b x - z|^2 + |ridge x|^2 by QR of the stacked system, and the inverse of its normal matrix."""
    q, r, pivot = scipy.linalg.qr(np.concatenate([b, np.diag(ridge)]), mode="economic", pivoting=True)
    keep = np.abs(np.diag(r)) > 1e-12 * abs(r[0, 0])
    if not keep.all():
        raise ValueError(f"least squares: no prior and no data for a combination with {names[int(pivot[np.flatnonzero(~keep)[0]])]}")
    n = len(names)
    x = np.empty(n)
    x[pivot] = scipy.linalg.solve_triangular(r, q.T @ np.concatenate([z, np.zeros(n)]))
    r_inv = np.empty((n, n))
    r_inv[pivot] = scipy.linalg.solve_triangular(r, np.eye(n))
    return x, r_inv @ r_inv.T


def _column_scale(a: F2) -> F1:
    norm = np.linalg.norm(a, axis=0)
    return np.where(norm > 0, 1.0 / np.where(norm > 0, norm, 1.0), 1.0)
