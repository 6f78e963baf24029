"""Posterior bound of the uncertainty where an artefact of unknown form was probed in several poses: in a plane of the machine, or in space.

Unlike the mountings of bars and lasers (`abbe.models.planning.problem`), poses share the unknown form of the artefact. So all poses are
evaluated together.
"""

from __future__ import annotations

import numpy as np
import scipy

from abbe.models.arrays import F2
from abbe.models.geometry.chain import design
from abbe.models.geometry.volume import rigid_design
from abbe.models.planning.problem import PlanningProblem
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe import LOST, run_design, setup_unknowns


def pose_uncertainty_mm(
    what: PlanningProblem, runs: tuple[RunData, ...], points_mm: F2, noise_mm: float, n_axes: int
) -> tuple[float, float]:
    """Return the standard uncertainty of the deviation at points: at the worst point, and rms, mm.

    The best-fit rigid motion is removed. ``n_axes``: 2, X and Y at points in a plane; 3, all axes. ``runs``: poses, and calibrated lengths
    of the artefact; ``noise_mm``: per reading.
    """
    n_terms = len(what.terms)
    setup = setup_unknowns(runs, what.priors, what.machine)
    full = np.concatenate([run_design(what.machine, what.terms, r, setup) * np.sqrt(r.weight_n)[:, None] for r in runs]) / noise_mm
    shared = full[:, : n_terms + LOST] @ what.root[: n_terms + LOST]
    a = np.concatenate([shared, full[:, n_terms + LOST :] * setup.prior_sd], axis=1)
    fields = design(what.machine, what.terms, points_mm)[:, :n_axes].reshape(n_axes * len(points_mm), -1)
    rows = _without_motion(points_mm, fields, n_axes) @ what.root[:n_terms]
    whole = np.concatenate([rows, np.zeros((len(rows), a.shape[1] - rows.shape[1]))], axis=1)
    factor = scipy.linalg.cho_factor(a.T @ a + np.eye(a.shape[1]))
    variance = np.einsum("ij,ji->i", whole, scipy.linalg.cho_solve(factor, whole.T)).reshape(-1, n_axes).sum(axis=1)
    return float(np.sqrt(variance.max())), float(np.sqrt(variance.mean()))


def _without_motion(points_mm: F2, rows: F2, n_axes: int) -> F2:
    motion = rigid_design(points_mm)[:, :n_axes]
    basis, _ = np.linalg.qr((motion if n_axes == 3 else motion[:, :, [0, 1, 5]]).reshape(n_axes * len(points_mm), -1))
    return np.asarray(rows - basis @ (basis.T @ rows))
