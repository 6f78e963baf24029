"""Mask of points where the uncertainty exceeds the error: they are not compensated.

The rule. A component of the deviation may be compensated where its size exceeds its expanded uncertainty, |d| > U = k u; with k of 95 % its
sign is then known. A point may be compensated where the deviation's length exceeds the expanded uncertainty along the deviation itself,
|d| > k sqrt(e^T C e), e = d / |d|. What is smaller may well be an error of the other sign, and a correction would then double it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from abbe.models.arrays import F1, F2
from abbe.models.solvers.joint import JointSolution
from abbe.models.solvers.priors import Priors, term_prior_sd
from abbe.models.uncertainty.coverage import PROBABILITY, coverage_factor
from abbe.models.uncertainty.frame import RigidFree, field
from abbe.models.uncertainty.prediction import Prediction

NO_TRACE_SIGMA = 0.3
"""A direction of typical size that changes all readings together by less than this many standard deviations leaves no trace."""


def unseen_directions(solution: JointSolution) -> F2:
    """Changes of the smooth terms, each of typical size, that leave no trace in any reading, shape (terms, q), mm and rad.

    Lost motion and set-up unknowns take their part first, within what is known of them.
    """
    n = len(solution.terms)
    typical = term_prior_sd(solution.machine, solution.terms, Priors())
    own, other = solution.information[:n, :n], solution.information[n:, n:]
    across = solution.information[:n, n:]
    taken = linalg.solve(other + np.diag(solution.prior_sd[n:] ** -2.0), across.T, assume_a="pos")
    left = (own - across @ taken) * np.outer(typical, typical)
    values, vectors = linalg.eigh(0.5 * (left + left.T))
    return np.asarray(typical[:, None] * vectors[:, values < NO_TRACE_SIGMA**2])


def unseen_mm(solution: JointSolution, points_mm: F2, frame: RigidFree, tool_mm: F1 | None = None) -> F1:
    """Rms length of the deviation that no reading shows, if errors have their typical sizes, at points, shape (m,), mm."""
    hidden = unseen_directions(solution)
    if not hidden.shape[1]:
        return np.zeros(len(points_mm))
    moved = field(solution.machine, solution.terms, points_mm, tool_mm, frame) @ hidden
    return np.asarray(np.sqrt(np.einsum("mcq,mcq->m", moved, moved)))


@dataclass(frozen=True)
class CompensableMask:
    """What may be compensated.

    Attributes
    ----------
    components : array of bool, shape (m, 3)
    points : array of bool, shape (m,)
    coverage_factor : array, shape (m,)
        k that the points were judged with.
    """

    components: NDArray[np.bool_]
    points: NDArray[np.bool_]
    coverage_factor: F1

    @property
    def share(self) -> float:
        """Part of the points that may be compensated, 0 to 1."""
        return float(self.points.mean())

    def text(self) -> str:
        """One line for people."""
        left = int((~self.points).sum())
        if left == 0:
            return "The deviation is larger than its uncertainty everywhere."
        k = np.median(self.coverage_factor)
        return f"At {left} of {self.points.size} points the uncertainty (k = {k:.2f}) is larger than the error: not compensated."


def compensable_mask(prediction: Prediction, *, k: float | None = None, smallest_mm: float = 0.0) -> CompensableMask:
    """Which points and components of a predicted deviation may be compensated.

    Parameters
    ----------
    prediction : Prediction
        In the frame that the correction is made in; rigid-free for a map (`abbe.models.uncertainty.frame`), or a displacement of the whole
        workpiece, which is no error, decides.
    k : float, optional
        Coverage factor; default: that of the prediction's own probability and degrees of freedom.
    smallest_mm : float
        Deviations below this are not worth a correction, however well they are known (the control's resolution).

    Raises
    ------
    ValueError
        k is not positive or ``smallest_mm`` negative.
    """
    if (k is not None and not k > 0) or smallest_mm < 0:
        raise ValueError("compensable mask: k must be positive and smallest_mm 0 or more")
    d = prediction.deviation_mm
    per_component = prediction.coverage_factor if k is None else np.full(d.shape, k)
    components = (np.abs(d) > per_component * prediction.u_mm) & (np.abs(d) > smallest_mm)
    length = np.linalg.norm(d, axis=1)
    along = d / np.where(length > 0, length, 1.0)[:, None]
    _, u = prediction.along(along)
    per_point = _along_factor(prediction, along) if k is None else np.full(len(d), k)
    points = (length > per_point * u) & (length > smallest_mm)
    return CompensableMask(components, points, per_point)


def _along_factor(prediction: Prediction, along: NDArray[np.float64]) -> F1:
    """Coverage factor along each deviation: that of the fewest degrees of freedom among the components that take part."""
    dof = np.where(np.abs(along) > 1e-9, prediction.dof, np.inf).min(axis=1)
    return coverage_factor(dof, prediction.probability or PROBABILITY)
