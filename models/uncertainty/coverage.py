"""Coverage factors and coverage intervals: Welch-Satterthwaite (GUM G.4), shortest and symmetric intervals of samples (GUM-S1 7.7)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2, F3
from abbe.models.probability import chi2_quantile, t_quantile

PROBABILITY = 0.95
_FLAT, _NOTHING = 1e-12, 1e-24
"""Eigenvalues below `_FLAT` times the largest, or below `_NOTHING` (mm^2), are rounding."""


def effective_dof(variances: F2, dof: F1) -> F1:
    """Effective degrees of freedom of sums of variances, (sum v)^2 / sum (v^2 / nu) (GUM eq G.2b).

    Parameters
    ----------
    variances : array, shape (s, m)
        Variance of each of s sources in each of m results.
    dof : array, shape (s,)
        Degrees of freedom of each source's variance; inf for a variance that is known exactly.

    Returns
    -------
    array, shape (m,); inf where no source with finite degrees of freedom takes part.
    """
    spread = (variances**2 / dof[:, None]).sum(axis=0)
    total = variances.sum(axis=0)
    return np.asarray(np.where(spread > 0, total**2 / np.where(spread > 0, spread, 1.0), np.inf))


def coverage_factor(dof: F1, probability: float = PROBABILITY) -> F1:
    """Coverage factor k: the two-sided quantile of Student's t; 1.96 for 95 % and many degrees of freedom."""
    _checked_probability(probability)
    return t_quantile(0.5 * (1.0 + probability), np.maximum(dof, 1.0))


def vector_factor(components: int = 3, probability: float = PROBABILITY) -> float:
    """Factor of the coverage ellipsoid of a normal vector, e.g. 2.80 for three components and 95 % (GUM-S2 6.5.2)."""
    _checked_probability(probability)
    return float(np.sqrt(chi2_quantile(probability, components)))


@dataclass(frozen=True)
class Interval:
    """Coverage intervals of each result, arrays of shape (m,)."""

    low: F1
    high: F1

    @property
    def width(self) -> F1:
        """Width of each interval, ``high`` minus ``low``."""
        return np.asarray(self.high - self.low)


def apart_from_zero(vectors: F2, covariance: F3, probability: float = PROBABILITY) -> NDArray[np.bool_]:
    """Whether the coverage ellipsoid of each vector excludes zero; at 95 % this is true for 5 % of all vectors of pure noise.

    Parameters
    ----------
    vectors : array, shape (n, c)
        Estimates, e.g. deviations in mm.
    covariance : array, shape (n, c, c)
        Covariance of each vector; it may be singular. A vector whose covariance is not finite does not exclude zero.

    Returns
    -------
    array of bool, shape (n,)
    """
    finite = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
    variances, axes = np.linalg.eigh(np.where(finite[:, None, None], covariance, 0.0))
    variances = np.maximum(variances, np.maximum(_FLAT * variances[:, -1:], _NOTHING))
    along = np.einsum("nij,ni->nj", axes, vectors)
    return np.asarray(finite & ((along**2 / variances).sum(axis=1) > vector_factor(vectors.shape[1], probability) ** 2))


def symmetric_interval(samples: F2, probability: float = PROBABILITY) -> Interval:
    """Probabilistically symmetric interval of samples, shape (trials, m): as many lie above it as below (GUM-S1 7.7.2)."""
    ordered = np.sort(samples, axis=0)
    trials = len(ordered)
    inside = _inside(trials, probability)
    first = (trials - inside + 1) // 2 - 1
    return Interval(ordered[max(first, 0)], ordered[max(first, 0) + inside])


def shortest_interval(samples: F2, probability: float = PROBABILITY) -> Interval:
    """Shortest interval of samples, shape (trials, m), that holds the probability (GUM-S1 7.7.4)."""
    ordered = np.sort(samples, axis=0)
    inside = _inside(len(ordered), probability)
    width = ordered[inside:] - ordered[:-inside]
    at = width.argmin(axis=0)
    columns = np.arange(ordered.shape[1])
    return Interval(ordered[at, columns], ordered[at + inside, columns])


def _inside(trials: int, probability: float) -> int:
    """Number of trials that the interval spans, q of GUM-S1 7.7.2."""
    _checked_probability(probability)
    inside = int(probability * trials + 0.5)
    if not 0 < inside < trials:
        raise ValueError(f"coverage interval: {trials} trials are too few for a probability of {probability}")
    return inside


def _checked_probability(probability: float) -> None:
    if not 0.0 < probability < 1.0:
        raise ValueError(f"coverage: probability {probability} must lie between 0 and 1")
