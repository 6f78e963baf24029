"""Weighted linear least squares with an explicit prior, full covariance, and an analysis of what the data determine.

`ParameterEstimate.data_share` gives for every parameter the fraction of its information that comes from the data. `Identifiability` gives
the rank, and names the combinations of parameters that only the prior determines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from abbe.models.arrays import F1, F2

RANK_TOLERANCE = 1e-9
EFFECTIVE_TOLERANCE = 1e-3
HIDDEN = 1e-6
"""A parameter takes part in a hidden combination if its component in the null space (unit columns) exceeds this."""
LEAST_SHARE = 1e-3
"""Texts name a member of a combination only if its weight is above this fraction of the largest."""


def svd(a: F2, *, full_matrices: bool = False) -> tuple[F2, F1, F2]:
    """Singular value decomposition a = u @ diag(s) @ vt.

    Divide and conquer (gesdd) is several times faster, but fails on some matrices with exactly dependent columns; QR iteration (gesvd)
    decomposes those.

    Raises
    ------
    ValueError
        An element of the matrix is not a finite number.
    """
    try:
        u, s, vt = scipy.linalg.svd(a, full_matrices=full_matrices, check_finite=False)
    except scipy.linalg.LinAlgError:
        u, s, vt = scipy.linalg.svd(a, full_matrices=full_matrices, lapack_driver="gesvd")
    return np.asarray(u), np.asarray(s), np.asarray(vt)


def singular_values(a: F2) -> F1:
    """Singular values only, largest first; errors as in `svd`."""
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
        max(1, chi2 / dof): residuals above the stated noise widen every uncertainty; smaller residuals do not reduce it.
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
    """Find the most probable parameters of ``y = a @ theta + noise`` with independent zero-mean normal priors.

    Parameters
    ----------
    a : array, shape (n, p)
    y, sigma : arrays, shape (n,)
        Observations and their standard uncertainty.
    prior_sd : array, shape (p,)
        Prior standard deviation; ``inf``: no prior.

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
        lost = names[int(pivot[np.flatnonzero(~keep)[0]])]
        raise ValueError(
            f"least squares: neither observations nor a prior determine {lost}, alone or with others: give {lost} a prior, or leave it out"
        )
    n = len(names)
    x = np.empty(n)
    x[pivot] = scipy.linalg.solve_triangular(r, q.T @ np.concatenate([z, np.zeros(n)]))
    r_inv = np.empty((n, n))
    r_inv[pivot] = scipy.linalg.solve_triangular(r, np.eye(n))
    return x, r_inv @ r_inv.T


def _column_scale(a: F2) -> F1:
    norm = np.linalg.norm(a, axis=0)
    return np.where(norm > 0, 1.0 / np.where(norm > 0, norm, 1.0), 1.0)


@dataclass(frozen=True, slots=True)
class Combination:
    """A direction of parameter space that leaves no trace in the observations.

    ``weights``: name and component of each parameter, in units of its typical size, largest first. Small components are included, because
    without them the direction would leave a trace. ``text``: a sentence about the ``members``.
    """

    weights: tuple[tuple[str, float], ...]
    text: str

    @property
    def members(self) -> tuple[str, ...]:
        """Names of the parameters with a share above `LEAST_SHARE`, largest first."""
        return _members(self.weights)


@dataclass(frozen=True)
class Identifiability:
    """Rank analysis of a scaled design.

    Attributes
    ----------
    n_parameters, rank, effective_rank : int
        Number of parameters; number of singular values above 1e-9 and above 1e-3 of the largest.
    condition : float
        Largest over smallest singular value counted in ``rank``.
    hidden : tuple of Combination
        The null space as sparse combinations.
    involved : frozenset of str
        Parameters that take part in the null space (`taking_part`); the data alone do not determine their values.
    """

    n_parameters: int
    rank: int
    effective_rank: int
    condition: float
    hidden: tuple[Combination, ...]
    involved: frozenset[str] = frozenset()


def taking_part(names: tuple[str, ...], null_space: F2) -> frozenset[str]:
    """Parameters that take part in a hidden combination; ``null_space``: orthonormal in unit columns, shape (p, k)."""
    size = np.linalg.norm(null_space, axis=1) if null_space.shape[1] else np.zeros(len(names))
    return frozenset(n for n, s in zip(names, size, strict=True) if s > HIDDEN)


def combinations_of(names: tuple[str, ...], null_space: F2) -> tuple[Combination, ...]:
    """Return the directions of a null space, shape (p, k), as combinations of few parameters each, with a sentence about each."""
    return tuple(_sentence(names, v) for v in sparse_rows(null_space.T))


def project_out(a: F2, nuisance: F2) -> F2:
    """Design without the part that set-up unknowns could explain: (I - N N+) a."""
    if nuisance.shape[1] == 0:
        return a
    norm = np.linalg.norm(nuisance, axis=0)
    u, s, _ = svd(nuisance[:, norm > 0] / norm[norm > 0], full_matrices=False)
    basis = u[:, s > RANK_TOLERANCE * s[0]] if s.size else u[:, :0]
    return np.asarray(a - basis @ (basis.T @ a))


def analyse(names: tuple[str, ...], a: F2, typical: F1 | None = None, *, tolerance: float = RANK_TOLERANCE) -> Identifiability:
    """Rank, condition and null space of a design.

    Parameters
    ----------
    a : array, shape (n, p)
        Whitened design, set-up unknowns projected out.
    typical : array, shape (p,), optional
        Typical size of each parameter; default: columns scaled to unit length.
    """
    norm = np.linalg.norm(a, axis=0)
    nonzero = norm > tolerance * (norm.max() if norm.size else 1.0)
    scale = np.where(nonzero, 1.0 / np.where(nonzero, norm, 1.0), 1.0) if typical is None else typical
    _, s, vt = svd(a * scale, full_matrices=True)
    s = np.concatenate([s, np.zeros(len(names) - s.size)])
    top = s[0] if s.size and s[0] > 0 else 1.0
    rank = int((s > tolerance * top).sum())
    effective = int((s > EFFECTIVE_TOLERANCE * top).sum())
    condition = float(top / s[rank - 1]) if rank else float("inf")
    null = vt[rank:].T
    return Identifiability(len(names), rank, effective, condition, combinations_of(names, null), taking_part(names, null))


def sparse_rows(null: F2) -> F2:
    """A sparse basis of the row space: reduced row echelon form with the largest pivot first."""
    m = np.array(null, dtype=np.float64)
    row = 0
    free = np.ones(m.shape[1], dtype=bool)
    while row < m.shape[0]:
        block = np.abs(m[row:]) * free
        i, j = divmod(int(block.argmax()), block.shape[1])
        if block[i, j] < 1e-9:
            break
        swap = np.array([row, row + i])
        m[swap] = m[swap[::-1]]
        m[row] /= m[row, j]
        others = np.arange(m.shape[0]) != row
        m[others] -= np.outer(m[others, j], m[row])
        free[j] = False
        row += 1
    m[np.abs(m) < 1e-7] = 0.0
    return m


def _members(parts: tuple[tuple[str, float], ...]) -> tuple[str, ...]:
    return tuple(n for n, w in parts if abs(w) > LEAST_SHARE)


def _sentence(names: tuple[str, ...], v: F1) -> Combination:
    order = np.argsort(-np.abs(v))
    parts = tuple((names[i], float(v[i])) for i in order if abs(v[i]) > HIDDEN)
    members = _members(parts)
    shown = members[:4]
    if len(members) == 1:
        text = f"{shown[0]} leaves no trace in these data"
    else:
        more = f" and {len(members) - 4} more" if len(members) > 4 else ""
        text = f"{', '.join(shown[:-1])} and {shown[-1]}{more} cannot be distinguished"
    return Combination(parts, text)


def unit_columns(a: F2) -> tuple[F2, F1]:
    """Scale the columns of a design to unit length and return the factors too; a column of zeros stays."""
    norm = np.linalg.norm(a, axis=0)
    factor: F1 = 1.0 / np.where(norm > 0, norm, 1.0)
    return np.asarray(a * factor), factor
