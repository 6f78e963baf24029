"""How the estimate of a campaign answers to its readings: the linear map from an error of each reading to an error of each unknown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from models.arrays import F1, F2
from models.solvers.joint import JointSolution
from models.solvers.observe import run_design


@dataclass(frozen=True)
class Response:
    """Design, weights and covariance of one solution, for the sizes of noise and priors that the solver settled on.

    Attributes
    ----------
    design : array, shape (n, p)
        Reading per unit of each unknown, all runs.
    weight : array, shape (n,)
        Weight of each reading, 1/mm^2: one over its variance, times what robustness and alike neighbours leave of it; 0 for a rejected one.
    kind : array of str, shape (n,)
        Instrument of each reading.
    covariance : array, shape (p, p)
        Posterior covariance for those sizes: (A^T W A + P^-1)^-1.
    widening : array, shape (p, q)
        Factor of what the solution's covariance holds on top: the sizes were estimated too, or the residuals are larger than stated.
    dof : float
        Degrees of freedom of the residuals.
    noise_estimated : bool
        Whether the noise was estimated from these residuals (then it has ``dof`` degrees of freedom), or stated.
    """

    design: F2
    weight: F1
    kind: np.ndarray[tuple[int, ...], np.dtype[np.str_]]
    covariance: F2
    widening: F2
    dof: float
    noise_estimated: bool

    def of_readings(self, error_mm: F1) -> F1:
        """Change of every unknown when each reading is wrong by ``error_mm`` (n,): C A^T W e, shape (p,)."""
        return np.asarray(self.covariance @ (self.design.T @ (error_mm * self.weight)))

    def noise_factor(self, variance_mm2: F1 | None, seen: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> F2:
        """Factor of the covariance that independent errors of some readings give the unknowns, shape (p, p).

        ``variance_mm2``: of each reading (n,); None: what its weight stands for. ``seen``: which readings have them.
        """
        size = np.sqrt(self.weight) if variance_mm2 is None else np.sqrt(variance_mm2) * self.weight
        r = linalg.qr(self.design[seen] * size[seen, None], mode="r")[0][: self.design.shape[1]]
        return np.asarray(self.covariance @ r.T)

    @property
    def gain(self) -> F2:
        """K = C A^T W, shape (p, n): change of every unknown per mm of each reading."""
        return np.asarray(self.covariance @ (self.design * self.weight[:, None]).T)


def response(solution: JointSolution) -> Response:
    """Design, weights and covariance of a solution, from its own runs, set-up and weights."""
    design = np.concatenate([run_design(solution.machine, solution.terms, run, solution.setup) for run in solution.data])
    prior = solution.prior_sd
    known = np.isfinite(prior)
    diagonal = np.diag(solution.information)
    scale = np.where(known, prior, 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)))
    normal = solution.information * np.outer(scale, scale) + np.diag(known.astype(np.float64))
    lower = linalg.cholesky(normal, lower=True)
    root = scale[:, None] * linalg.solve_triangular(lower, np.eye(len(prior)), lower=True).T
    covariance = root @ root.T
    kind = np.concatenate([np.full(run.deviation_mm.size, run.kind) for run in solution.data])
    widening = _widening(solution.estimate.covariance, covariance, scale)
    return Response(
        design, reading_weights(solution), kind, covariance, widening, solution.estimate.dof, bool(getattr(solution, "noise_mm", None))
    )


def _widening(whole: F2, covariance: F2, scale: F1) -> F2:
    """Factor of what is left of the solution's covariance; nothing below a part in 10^9 of the prior."""
    value, vector = linalg.eigh((whole - covariance) / np.outer(scale, scale))
    kept = value > 1e-9
    return np.asarray(scale[:, None] * vector[:, kept] * np.sqrt(value[kept]))


def reading_weights(solution: JointSolution) -> F1:
    """Weight of each reading of the campaign in the solution, 1/mm^2, shape (n,)."""
    stated = getattr(solution, "weight_per_mm2", None)
    if stated is not None:
        return np.asarray(stated)
    return np.concatenate(
        [np.full(run.deviation_mm.size, fit.expected_mm**-2) for fit, run in zip(solution.runs, solution.data, strict=True)]
    )
