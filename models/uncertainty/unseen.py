"""How large the part of the deviation may be of which no reading tells anything: typical sizes stand in for knowledge there.

The stated uncertainty of a solution holds sizes that were learned from what the readings do show. That guideways are straight where they
were seen says little of a twist that nothing shows; for what leaves no trace the documented size counts (`abbe.models.solvers.priors`).
"""

from __future__ import annotations

import numpy as np
from scipy import linalg

from abbe.models.arrays import F1, F2
from abbe.models.solvers.joint import JointSolution
from abbe.models.solvers.priors import Priors, term_prior_sd
from abbe.models.uncertainty.frame import RigidFree, field

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
