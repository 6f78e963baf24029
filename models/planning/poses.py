"""Posterior bound of the uncertainty in a plane of the machine in which an artefact of unknown form was probed in several poses.

Unlike the mountings of bars and lasers (`abbe.models.planning.problem`), poses share the unknown form of the artefact. So all poses are
evaluated together.
"""

from __future__ import annotations

import numpy as np
import scipy

from abbe.models.arrays import F2
from abbe.models.geometry.chain import design
from abbe.models.planning.problem import PlanningProblem
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe import LOST, run_design, setup_unknowns


def plane_uncertainty_mm(what: PlanningProblem, runs: tuple[RunData, ...], points_mm: F2, noise_mm: float) -> tuple[float, float]:
    """Return the standard uncertainty of the deviation in X and Y at points in a plane: at the worst point, and rms, mm.

    The best-fit rigid motion in the plane is removed. ``runs``: poses, and calibrated lengths of the artefact; ``noise_mm``: per reading.
    """
    n_terms = len(what.terms)
    setup = setup_unknowns(runs, what.priors, what.machine)
    full = np.concatenate([run_design(what.machine, what.terms, r, setup) * np.sqrt(r.weight_n)[:, None] for r in runs]) / noise_mm
    shared = full[:, : n_terms + LOST] @ what.root[: n_terms + LOST]
    a = np.concatenate([shared, full[:, n_terms + LOST :] * setup.prior_sd], axis=1)
    rows = _in_plane(points_mm, design(what.machine, what.terms, points_mm)[:, :2].reshape(2 * len(points_mm), -1)) @ what.root[:n_terms]
    whole = np.concatenate([rows, np.zeros((len(rows), a.shape[1] - rows.shape[1]))], axis=1)
    factor = scipy.linalg.cho_factor(a.T @ a + np.eye(a.shape[1]))
    variance = np.einsum("ij,ji->i", whole, scipy.linalg.cho_solve(factor, whole.T)).reshape(-1, 2).sum(axis=1)
    return float(np.sqrt(variance.max())), float(np.sqrt(variance.mean()))


def _in_plane(points_mm: F2, rows: F2) -> F2:
    away = points_mm[:, :2] - points_mm[:, :2].mean(axis=0)
    rigid = np.zeros((len(away), 2, 3))
    rigid[:, 0, 0] = rigid[:, 1, 1] = 1.0
    rigid[:, :, 2] = np.stack([-away[:, 1], away[:, 0]], axis=1)
    basis, _ = np.linalg.qr(rigid.reshape(-1, 3))
    return np.asarray(rows - basis @ (basis.T @ rows))
