"""All sources of a solution together, for any results that are linear in its coefficients: variances, and one factor for draws.

Nothing is left out: noise and priors of the solution, what orders above the chosen one may do, and the stated inputs (wavelength,
temperatures). ``solution.term_covariance`` alone holds only the first two.
"""

from __future__ import annotations

import numpy as np
from scipy import linalg

from abbe.models.arrays import F1, F2
from abbe.models.uncertainty.sources import ErrorSources


def variances(sources: ErrorSources, per_unit: F2) -> F1:
    """Variance of each of m results, shape (m,), without the scatter of a single approach.

    Parameters
    ----------
    sources : ErrorSources
    per_unit : array, shape (m, len(sources.terms))
        Result per unit of each coefficient, those of the orders above the solution's included.
    """
    total = np.zeros(len(per_unit))
    for s in sources.sources:
        share = np.sum((per_unit @ s.factor) ** 2, axis=1)
        if s.less is not None:
            share = np.maximum(share - np.sum((per_unit @ s.less) ** 2, axis=1), 0.0)
        total += share
    return total


def joint_factor(sources: ErrorSources, per_unit: F2) -> F2:
    """Factor F of the covariance F F^T of m results together, shape (m, q), for draws that keep them in step.

    What the estimated sizes add is cut off where it would make a combination of these results better than the rest says.
    """
    turn, small = linalg.qr(per_unit, mode="economic") if len(per_unit) > per_unit.shape[1] else (None, per_unit)
    total = np.zeros((len(small), len(small)))
    for s in sources.sources:
        plus = small @ s.factor
        share = plus @ plus.T
        if s.less is not None:
            less = small @ s.less
            root = _root(share - less @ less.T)
            share = root @ root.T
        total += share
    found = _root(total)
    return found if turn is None else np.asarray(turn @ found)


def approach_variance_mm2(sources: ErrorSources) -> float:
    """Variance per component that a single approach of a point adds (`Inputs.single_approach`), else 0."""
    return float(sum(s.scatter_mm**2 for s in sources.sources))


def _root(covariance: F2) -> F2:
    """Factor of the nearest matrix without negative variances."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
