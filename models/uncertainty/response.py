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
    """Design, weights and covariance of one solution.

    Attributes
    ----------
    design : array, shape (n, p)
        Reading per unit of each unknown, all runs.
    sigma_mm : array, shape (n,)
        Standard uncertainty that each reading was weighted with.
    covariance : array, shape (p, p)
        Posterior covariance for the stated noise, before the misfit widened it.
    covariance_root : array, shape (p, p)
        Triangular factor of it: covariance = root root^T.
    misfit : float
        By how much the residuals widened it (`models.solvers.least_squares.Estimate.variance_factor`).
    noise_dof : float
        Degrees of freedom of the noise figures: those of the residuals where they were estimated, inf where they were stated.
    """

    design: F2
    sigma_mm: F1
    covariance: F2
    covariance_root: F2
    misfit: float
    noise_dof: float

    def of_readings(self, error_mm: F1) -> F1:
        """Change of every unknown when each reading is wrong by ``error_mm`` (n,): C A^T W e, shape (p,)."""
        return np.asarray(self.covariance @ (self.design.T @ (error_mm / self.sigma_mm**2)))

    def noise_factor(self, variance_mm2: F1) -> F2:
        """Factor of the covariance that independent errors of this variance per reading (n,) give the unknowns, shape (p, p)."""
        weighted = self.design * (np.sqrt(variance_mm2) / self.sigma_mm**2)[:, None]
        r = linalg.qr(weighted, mode="r")[0][: self.design.shape[1]]
        return np.asarray(self.covariance @ r.T)


def response(solution: JointSolution) -> Response:
    """Design, weights and covariance of a solution, from its own runs, set-up and information."""
    design = np.concatenate([run_design(solution.machine, solution.terms, run, solution.setup) for run in solution.data])
    prior = solution.prior_sd
    known = np.isfinite(prior)
    diagonal = np.diag(solution.information)
    scale = np.where(known, prior, 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)))
    normal = solution.information * np.outer(scale, scale) + np.diag(known.astype(np.float64))
    lower = linalg.cholesky(normal, lower=True)
    root = scale[:, None] * linalg.solve_triangular(lower, np.eye(len(prior)), lower=True).T
    dof = solution.estimate.dof if getattr(solution, "noise_mm", None) else float("inf")
    return Response(design, reading_sigma(solution), root @ root.T, root, solution.estimate.variance_factor, dof)


def reading_sigma(solution: JointSolution) -> F1:
    """Standard uncertainty that each reading of the campaign was weighted with, mm, shape (n,)."""
    parts = []
    for fit, run in zip(solution.runs, solution.data, strict=True):
        parts.append(np.full(run.deviation_mm.size, fit.expected_mm))
    return np.concatenate(parts)
