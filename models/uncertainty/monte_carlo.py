"""Propagation of distributions by Monte Carlo with as many trials as the wanted digits need (GUM-S1 7).

`validate` checks the GUM's law of propagation against the trials (GUM-S1 8).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.uncertainty.coverage import PROBABILITY, Interval, shortest_interval, symmetric_interval
from abbe.models.uncertainty.distributions import Moments

Draw = Callable[[np.random.Generator, int], F2]
"""Function of the number of trials to results, shape (trials, m): inputs drawn from their distributions, propagated through the model."""
BATCH = 10_000
"""Fewest trials of one batch; 100 / (1 - p) where that is more (GUM-S1 7.9.4)."""
FEWEST_BATCHES = 10
"""Fewest batches: ten show their spread to 25 %, while two show less than a tenth of it in one case of twelve."""
LARGEST = 1_000_000
VALIDATION_SHARE = 0.2
"""Trials that check the law of propagation must be known to this fraction of the check's tolerance (GUM-S1 8.2)."""
COLUMNS = 300
"""Number of results whose trials are sorted together."""


@dataclass(frozen=True)
class MonteCarlo:
    """Statistics of m results from trials.

    Attributes
    ----------
    mean, u : array, shape (m,)
    covariance : array, shape (m, m)
    symmetric, shortest : Interval
        Coverage intervals: probabilistically symmetric, and shortest. Each is a mean over batches, so that no trial is kept.
    probability : float
    trials : int
    tolerance : array, shape (m,)
        Requested numerical tolerance: half a unit of the last wanted digit of u, times ``share`` of `adaptive`.
    settled : array of bool, shape (m,)
        Whether mean, u and the ends of both intervals are known to this tolerance, at 95 %.
    ends_known : array, shape (m,)
        Numerical uncertainty (95 %) of the less certain end of the symmetric interval; inf with fewer than `FEWEST_BATCHES` batches.
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
    ends_known: F1


def adaptive(
    draw: Draw,
    rng: np.random.Generator,
    *,
    probability: float = PROBABILITY,
    digits: int = 2,
    share: float = 1.0,
    largest: int = LARGEST,
) -> MonteCarlo:
    """Run batches of trials, at least `FEWEST_BATCHES`, until every figure is stable (GUM-S1 7.9.4).

    Parameters
    ----------
    draw : callable
        Returns the results of one batch of trials, shape (trials, m). A batch takes 0.24 MB per point; the peak is about three times this.
    rng : Generator
        Seeded by the caller; the same seed gives the same figures.
    digits : int
        Significant digits of u that must be right: 1 or 2 (GUM-S1 7.9.2).
    share : float
        Tolerance as a fraction of half a unit of the last digit; `VALIDATION_SHARE` for trials passed to `validate`.
    largest : int
        Most trials; ``settled`` is False for results that are not stable by then.

    Raises
    ------
    ValueError
        ``digits`` is neither 1 nor 2, ``share`` is not in (0, 1], or ``largest`` is less than one batch.
    """
    batch = batch_size(probability)
    if digits not in (1, 2) or not 0.0 < share <= 1.0:
        raise ValueError(f"Monte Carlo: digits {digits}, must be 1 or 2; share {share}, must be above 0 and at most 1")
    if largest < batch:
        raise ValueError(f"Monte Carlo: {largest} trials are too few for intervals of {probability:.4g}: one batch has {batch}")
    figures: list[F2] = []
    moments: Moments | None = None
    while True:
        results = draw(rng, batch)
        moments = moments or Moments(results.mean(axis=0))
        moments.add(results)
        figures.append(_figures(results, probability))
        u = np.sqrt(np.diag(moments.covariance))
        tolerance = share * numerical_tolerance(u, digits)
        known = _known(figures)
        settled = (known <= tolerance).all(axis=0)
        if settled.all() or moments.count + batch > largest:
            break
    middle = np.mean(figures, axis=0)
    both = Interval(middle[2], middle[3]), Interval(middle[4], middle[5])
    return MonteCarlo(
        moments.mean, u, moments.covariance, *both, probability, moments.count, tolerance, np.asarray(settled), known[2:4].max(axis=0)
    )


def batch_size(probability: float) -> int:
    """Trials of one batch: 10^4, or 100 / (1 - p) where that is more (GUM-S1 7.9.4).

    Raises
    ------
    ValueError
        The probability is not between 0 and 1.
    """
    if not 0.0 < probability < 1.0:
        raise ValueError(f"Monte Carlo: probability {probability} must lie between 0 and 1")
    return max(BATCH, int(np.ceil(100.0 / (1.0 - probability) - 1e-6)))


def _figures(results: F2, probability: float) -> F2:
    """Mean, u and the ends of both intervals of one batch, shape (6, m); sorted in parts to save memory."""
    out = np.empty((6, results.shape[1]))
    for i in range(0, results.shape[1], COLUMNS):
        part = results[:, i : i + COLUMNS]
        ends = (symmetric_interval(part, probability), shortest_interval(part, probability))
        out[:, i : i + COLUMNS] = [part.mean(axis=0), part.std(axis=0, ddof=1), *(e for k in ends for e in (k.low, k.high))]
    return out


def _known(figures: list[F2]) -> F2:
    """Numerical uncertainty of every figure, (6, m): twice the standard deviation of its mean over batches; inf for too few batches."""
    if len(figures) < FEWEST_BATCHES:
        return np.full(figures[0].shape, np.inf)
    return np.asarray(2.0 * np.std(figures, axis=0, ddof=1) / np.sqrt(len(figures)))


def numerical_tolerance(u: F1, digits: int) -> F1:
    """Half a unit in the last of ``digits`` significant digits of u (GUM-S1 7.9.2); infinite where u is zero."""
    size = np.where(u > 0, u, 1.0)
    exponent = np.floor(np.log10(size)) - (digits - 1)
    return np.where(u > 0, 0.5 * 10.0**exponent, np.inf)


@dataclass(frozen=True)
class Validation:
    """Check of the law of propagation against Monte Carlo, shapes (m,).

    ``low``, ``high``: differences of the two ends of the coverage interval between the two methods.
    """

    low: F1
    high: F1
    tolerance: F1

    @property
    def valid(self) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Whether both ends agree within the tolerance, for each result (GUM-S1 8.1)."""
        return np.asarray((self.low <= self.tolerance) & (self.high <= self.tolerance))


def validate(value: F1, expanded: F1, found: MonteCarlo, *, digits: int = 1) -> Validation:
    """Compare the interval of the law of propagation, value -+ U, with the symmetric one of the trials (GUM-S1 8.1).

    Parameters
    ----------
    value, expanded : array, shape (m,)
        Estimates, and expanded uncertainties U by the law of propagation.
    found : MonteCarlo
        Trials of the same results at the same probability, from ``adaptive(..., digits=digits, share=VALIDATION_SHARE)``, so that the ends
        of their intervals are known to a fifth of the tolerance of this check (GUM-S1 8.2).
    digits : int
        Significant digits of u; the tolerance is half a unit of the last.

    Raises
    ------
    ValueError
        The interval ends of the trials are not known well enough.
    """
    tolerance = numerical_tolerance(found.u, digits)
    if not (found.ends_known <= VALIDATION_SHARE * tolerance).all():
        raise ValueError(
            f"Monte Carlo: {found.trials} trials are too few to validate the law of propagation: the intervals' ends must be known to "
            f"{VALIDATION_SHARE} of the numerical tolerance of u at {digits} digits; run adaptive(..., digits={digits}, "
            f"share={VALIDATION_SHARE})"
        )
    return Validation(np.abs(value - expanded - found.symmetric.low), np.abs(value + expanded - found.symmetric.high), tolerance)
