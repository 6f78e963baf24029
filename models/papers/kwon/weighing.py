"""How much noise and how wide a prior the points themselves demand, before anything is claimed from them.

Two statements come from the user: the uncertainty of a point and the width of the prior. Both can be too small, and the points tell which:
what no parameter can follow measures the noise alone, prior or not; what the parameters follow, in the directions that the points carry,
measures the prior. Neither is ever made smaller than stated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize, special

from abbe.models.arrays import F1, F2
from abbe.models.solvers.identifiability import project_out

CONFLICT = 0.01
"""Probability below which the deviations contradict the stated prior."""
UNSEEN = 1e-9
"""Singular values below this share of the largest leave no trace (as abbe.models.solvers.identifiability)."""
SPATIAL = 3
"""Coordinates of a point."""
STRAY = 0.01
"""Probability that any point of a good set is called outlying."""


@dataclass(frozen=True, slots=True)
class PriorTest:
    """Whether the stated prior and the points contradict each other.

    Attributes
    ----------
    chi2 : float
        Sum of squares of the deviations found, in the directions that the points carry better than the stated prior, each in units of the
        size that the stated prior lets expect.
    dof : int
        Number of these directions. The prior of all others cannot be tested.
    p : float
        Probability of a larger chi2 if the true deviations came from the stated prior; 1 when nothing is carried.
    """

    chi2: float
    dof: int
    p: float

    @property
    def conflict(self) -> bool:
        """p below 0.01."""
        return self.p < CONFLICT


@dataclass(frozen=True, slots=True)
class Weights:
    """What to weigh points and prior with.

    Attributes
    ----------
    variance_factor : float
        Of the points, 1 or more: residual that no parameter can follow over its degrees of freedom.
    prior_factor : float
        Of the prior standard deviations, 1 or more and the same for all, for want of anything that tells them apart: what brings
        ``test.chi2`` down to its dof or, from twice the dof on, to dof - 2 (dof / 2 below 4), because a factor that was itself estimated
        from so few directions is too small as often as too large.
    carried : int
        Directions about which the points say more than the prior, with both factors.
    test : PriorTest
        Of the prior as stated, noise already scaled.
    """

    variance_factor: float
    prior_factor: float
    carried: int
    test: PriorTest


def weigh(design: F2, observed: F1, prior_sd: F1) -> Weights:
    """Look at whitened, linear observations ``observed = design @ (theta, placement) + noise``.

    With the placement projected out and theta in units of its prior, every singular direction gives one number of the variance
    ``variance_factor + (prior_factor x singular value)^2``; the rest of the observations is noise alone.

    Parameters
    ----------
    design : array, shape (m, p + q)
        In units of the noise; the last q columns (placement) have no prior.
    observed : array, shape (m,)
    prior_sd : array, shape (p,)
    """
    own, free = design[:, : prior_sd.size] * prior_sd, design[:, prior_sd.size :]
    target = project_out(observed[:, None], free)[:, 0]
    u, s, _ = np.linalg.svd(project_out(own, free), full_matrices=False)
    seen = s > UNSEEN * s[0]
    u, s = u[:, seen], s[seen]
    along = u.T @ target
    left = target - u @ along
    dof = observed.size - int(np.linalg.matrix_rank(free)) - s.size if free.size else observed.size - s.size
    variance = max(1.0, float(left @ left) / dof) if dof > 0 else 1.0
    carried = s**2 > variance
    y2, s2 = along[carried] ** 2, s[carried] ** 2
    chi2, k = float((y2 / (variance + s2)).sum()), int(carried.sum())
    test = PriorTest(chi2, k, float(special.chdtrc(k, chi2)) if k else 1.0)
    factor = _prior_factor(y2, s2, variance)
    return Weights(variance, factor, int(((factor * s) ** 2 > variance).sum()), test)


def outlying_points(residual: F2) -> tuple[int, ...]:
    """Rows whose residual stands out from the others: not one in a set of good points, in 99 of 100 sets.

    Parameters
    ----------
    residual : array, shape (n, 3)
        In units of the stated uncertainty; the median length of all rows, where it is larger than that lets expect, sets the scale.
    """
    length2 = (residual**2).sum(axis=1)
    scale = max(1.0, float(np.median(length2) / special.chdtri(SPATIAL, 0.5)))
    limit = float(special.chdtri(SPATIAL, STRAY / max(length2.size, 1)))
    return tuple(int(i) for i in np.flatnonzero(length2 > limit * scale))


def _prior_factor(y2: F1, s2: F1, variance: float) -> float:
    """Smallest factor of the prior, 1 or more, for which the sum of y^2 / (variance + factor^2 s^2) is not above its target."""
    if y2.size == 0:
        return 1.0
    size, at_one = float(y2.size), float((y2 / (variance + s2)).sum())
    if at_one <= size:
        return 1.0
    # Gradual, so that an iteration cannot swing between two targets.
    target = size - min(2.0, 0.5 * size) * min(at_one / size - 1.0, 1.0)

    def excess(factor2: float) -> float:
        return float((y2 / (variance + factor2 * s2)).sum()) - target

    # s^2 is above the variance here: twice the factor that s^2 alone would need is always enough.
    return float(np.sqrt(optimize.brentq(excess, 1.0, 2.0 * at_one / target, xtol=1e-12, rtol=1e-12)))
