"""How the estimate of a campaign answers to its readings: the linear map from an error of each reading to an error of each unknown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from abbe.models.arrays import F1, F2
from abbe.models.solvers.joint import JointSolution
from abbe.models.solvers.observe import run_design


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
    pull : array, shape (p, p)
        Change of every unknown per standard deviation of each independent part of the prior (`prior_factor`): pull pull^T is the prior's
        share C P^-1 C.
    widening : array, shape (p, p)
        What the solution's covariance holds on top because the sizes were estimated too. Not positive in every direction.
    dof : float
        Degrees of freedom of all residuals together.
    """

    design: F2
    weight: F1
    kind: np.ndarray[tuple[int, ...], np.dtype[np.str_]]
    covariance: F2
    pull: F2
    widening: F2
    dof: float

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

    def dof_of(self, kind: str) -> float:
        """Degrees of freedom of the residuals of one instrument, from which its noise was estimated: its part of `dof`, at least 1.

        A reading keeps what it does not take to determine itself: one minus its leverage.
        """
        leverage = self.weight * np.einsum("np,pq,nq->n", self.design, self.covariance, self.design, optimize=True)
        left = np.where(self.weight > 0, np.clip(1.0 - leverage, 0.0, 1.0), 0.0)
        total = float(left.sum())
        return max(1.0, self.dof * float(left[self.kind == kind].sum()) / total) if total > 0 else 1.0

    @property
    def gain(self) -> F2:
        """K = C A^T W, shape (p, n): change of every unknown per mm of each reading."""
        return np.asarray(self.covariance @ (self.design * self.weight[:, None]).T)


def response(solution: JointSolution) -> Response:
    """Design, weights and covariance of a solution, from its own runs, set-up, weights and prior."""
    design = np.concatenate([run_design(solution.machine, solution.terms, run, solution.setup) for run in solution.data])
    kind = np.concatenate([np.full(run.deviation_mm.size, run.kind) for run in solution.data])
    root = prior_factor(solution.prior_root)
    normal = root.T @ solution.information @ root
    np.fill_diagonal(normal, normal.diagonal() + 1.0)
    inner = linalg.solve_triangular(linalg.cholesky(normal, lower=True), root.T, lower=True)
    pull = linalg.cho_solve((linalg.cholesky(normal, lower=True), True), root.T).T  # C R^-T
    covariance = inner.T @ inner
    widening = solution.estimate.covariance - covariance
    return Response(design, solution.weight_per_mm2, kind, covariance, pull, widening, solution.estimate.dof)


def prior_factor(root: F2) -> F2:
    """Triangular factor of the prior covariance root root^T: what each unknown adds to those before it, low orders of a motion first."""
    scale = np.linalg.norm(root, axis=1)
    return np.asarray(scale[:, None] * linalg.qr((root / scale[:, None]).T, mode="r")[0].T)
