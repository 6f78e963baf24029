"""Propagation of distributions by Monte Carlo, with as many trials as the wanted digits need (GUM-S1 7), and the test of the GUM by it
(8)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from models.arrays import F1, F2
from models.uncertainty.coverage import PROBABILITY, Interval, shortest_interval, symmetric_interval
from models.uncertainty.moments import Moments

Draw = Callable[[np.random.Generator, int], F2]
"""Results of so many trials, shape (trials, m): inputs drawn from their distributions, sent through the whole measurement."""
BATCH = 10_000
"""Trials of one batch: GUM-S1 7.9.4 asks for 10^4, or 100 / (1 - p) where that is more."""
LARGEST = 1_000_000


@dataclass(frozen=True)
class MonteCarlo:
    """What the trials say of m results.

    Attributes
    ----------
    mean, u : array, shape (m,)
    covariance : array, shape (m, m)
    symmetric, shortest : Interval
        Coverage intervals: as much outside below as above; the shortest of all. Each is the mean over batches, so that no trial is kept.
    probability : float
    trials : int
    tolerance : array, shape (m,)
        Numerical tolerance that was asked for: half a unit of the last wanted digit of u.
    settled : array of bool, shape (m,)
        Whether mean, u and both ends of the shortest and the symmetric interval are known that well, at 95 %.
    """

    mean: F1
    u: F1
    covariance: F2
    symmetric: Interval
    shortest: Interval
    probability: float
    trials: int
    tolerance: F1
    settled: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]


def adaptive(
    draw: Draw,
    rng: np.random.Generator,
    *,
    probability: float = PROBABILITY,
    digits: int = 2,
    batch: int = BATCH,
    largest: int = LARGEST,
) -> MonteCarlo:
    """Run batches of trials until every figure is stable (GUM-S1 7.9.4).

    Parameters
    ----------
    draw : callable
        Gives the results of one batch; its memory is the only one that grows with the batch.
    rng : Generator
        Seeded by the caller; the same seed gives the same figures.
    digits : int
        How many digits of u shall be right: 1 or 2 (GUM-S1 7.9.2).
    batch, largest : int
        Trials of one batch; where to give up. What did not settle by then says so.

    Raises
    ------
    ValueError
        ``digits`` is neither 1 nor 2, or a batch is too small for the probability.
    """
    if digits not in (1, 2):
        raise ValueError(f"Monte Carlo: digits {digits}, must be 1 or 2")
    if batch < 10.0 / (1.0 - probability):
        raise ValueError(f"Monte Carlo: {batch} trials per batch are too few for intervals of {probability:.0%}")
    figures: list[F2] = []
    moments: Moments | None = None
    while True:
        results = draw(rng, batch)
        moments = moments or Moments(results.mean(axis=0))
        moments.add(results)
        ends = (symmetric_interval(results, probability), shortest_interval(results, probability))
        figures.append(np.stack([results.mean(axis=0), results.std(axis=0, ddof=1), *(e for i in ends for e in (i.low, i.high))]))
        u = np.sqrt(np.diag(moments.covariance))
        tolerance = numerical_tolerance(u, digits)
        settled = np.zeros(u.size, dtype=np.bool_)
        if len(figures) > 1:
            spread = np.std(figures, axis=0, ddof=1) / np.sqrt(len(figures))
            settled = (2.0 * spread <= tolerance).all(axis=0)
        if settled.all() or moments.count + batch > largest:
            break
    middle = np.mean(figures, axis=0)
    both = Interval(middle[2], middle[3]), Interval(middle[4], middle[5])
    return MonteCarlo(moments.mean, u, moments.covariance, *both, probability, moments.count, tolerance, settled)


def numerical_tolerance(u: F1, digits: int) -> F1:
    """Half a unit in the last of ``digits`` significant digits of u (GUM-S1 7.9.2); infinite where u is zero: nothing to be resolved."""
    size = np.where(u > 0, u, 1.0)
    exponent = np.floor(np.log10(size)) - (digits - 1)
    return np.where(u > 0, 0.5 * 10.0**exponent, np.inf)


@dataclass(frozen=True)
class Validation:
    """Whether the law of propagation may be used: differences of the interval's ends from Monte Carlo, shape (m,), against the
    tolerance."""

    low: F1
    high: F1
    tolerance: F1

    @property
    def valid(self) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Both ends agree within the tolerance, per result (GUM-S1 8.1)."""
        return np.asarray((self.low <= self.tolerance) & (self.high <= self.tolerance))


def validate(value: F1, expanded: F1, found: MonteCarlo, *, digits: int = 1) -> Validation:
    """Compare the interval of the law of propagation, value -+ U, with the symmetric one of the trials (GUM-S1 8.1).

    Parameters
    ----------
    value, expanded : array, shape (m,)
    found : MonteCarlo
        Of the same results and probability, with a numerical tolerance no larger than a fifth of the one meant here (GUM-S1 8.2).
    digits : int
        Of u that are taken to be meaningful.
    """
    tolerance = numerical_tolerance(found.u, digits)
    return Validation(np.abs(value - expanded - found.symmetric.low), np.abs(value + expanded - found.symmetric.high), tolerance)
