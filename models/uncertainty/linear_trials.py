"""Monte Carlo of a linear campaign: every trial simulates all readings and solves anew, with one factorisation for all trials."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from abbe.models.arrays import F1, F2
from abbe.models.uncertainty.distributions import NORMAL, Distribution
from abbe.models.uncertainty.moments import Moments

CHUNK_VALUES = 500_000
"""Simulated readings held at once: 4 MB, so that they stay in the processor's cache between drawing and solving."""


@dataclass(frozen=True)
class LinearEstimator:
    """Weighted least squares with zero-mean normal priors as one matrix: theta = gain @ readings.

    ``gain``: shape (p, n); ``prior_gain``: what a prior mean, in its own standard deviations, adds, shape (p, p).
    """

    gain: F2
    prior_gain: F2
    sigma_mm: F1

    def solve(self, readings_mm: F2) -> F2:
        """Estimates of many trials at once, readings (trials, n) to (trials, p)."""
        return np.asarray(readings_mm @ self.gain.T)

    @property
    def covariance(self) -> F2:
        """Covariance by propagation of the readings' noise alone, K Sigma K^T, shape (p, p)."""
        scaled = self.gain * self.sigma_mm
        return np.asarray(scaled @ scaled.T)


def linear_estimator(a: F2, sigma_mm: F1, prior_sd: F1 | None = None) -> LinearEstimator:
    """Factorise a campaign once.

    Parameters
    ----------
    a : array, shape (n, p)
        Reading per unit of each unknown.
    sigma_mm : array, shape (n,)
        Standard uncertainty of each reading.
    prior_sd : array, shape (p,), optional
        Prior standard deviations, inf for none; default none at all.

    Raises
    ------
    ValueError
        Shapes disagree, a sigma is not positive, or a combination of unknowns has neither data nor prior.
    """
    n, p = a.shape
    prior = np.full(p, np.inf) if prior_sd is None else prior_sd
    if not np.isfinite(a).all():
        raise ValueError("linear trials: the design holds numbers that are not finite")
    if sigma_mm.shape != (n,) or prior.shape != (p,) or not (sigma_mm > 0).all() or not (prior > 0).all():
        raise ValueError(f"linear trials: design {a.shape}, sigma {sigma_mm.shape} and prior {prior.shape} do not fit or are not positive")
    known = np.isfinite(prior)
    norm = np.linalg.norm(a / sigma_mm[:, None], axis=0)
    scale = np.where(known, prior, 1.0 / np.where(norm > 0, norm, 1.0))
    stacked = np.concatenate([a * scale / sigma_mm[:, None], np.diag(known.astype(np.float64))])
    q, r = linalg.qr(stacked, mode="economic")
    size = np.abs(np.diag(r))
    if size.min() <= 1e-12 * size.max():
        raise ValueError("linear trials: a combination of unknowns has neither data nor prior")
    whole = scale[:, None] * linalg.solve_triangular(r, q.T)
    return LinearEstimator(np.ascontiguousarray(whole[:, :n] / sigma_mm), np.ascontiguousarray(whole[:, n:]), sigma_mm)


@dataclass(frozen=True)
class TrialStatistics:
    """Mean (p,) and covariance (p, p) of the estimates of so many trials; ``failed``: how many did not converge and are not counted."""

    mean: F1
    covariance: F2
    trials: int
    failed: int = 0


def linear_trials(
    estimator: LinearEstimator,
    readings_mm: F1,
    rng: np.random.Generator,
    trials: int,
    *,
    noise: Distribution = NORMAL,
) -> TrialStatistics:
    """Mean and covariance of the estimates when the readings are measured again and again.

    Parameters
    ----------
    estimator : LinearEstimator
    readings_mm : array, shape (n,)
        Readings about which each trial scatters: those of the campaign, or of an assumed machine.
    rng : Generator
        Seeded by the caller: the same seed gives the same figures, whatever the chunks.
    trials : int
    noise : Distribution
        Of each reading, in units of its standard uncertainty.

    Returns
    -------
    TrialStatistics
        From ``trials`` times n simulated readings; memory stays at `CHUNK_VALUES` of them. The noise is drawn and solved in single
        precision (seven digits of what is random anyway), readings and sums are double.

    Raises
    ------
    ValueError
        No trials are asked for, or readings are not finite.
    """
    n = readings_mm.size
    if trials < 1 or not np.isfinite(readings_mm).all():
        raise ValueError(f"linear trials: {trials} trials of readings, must be 1 or more of finite readings")
    centre = estimator.gain @ readings_mm
    unit = np.sqrt(np.diag(estimator.covariance))
    scaled = np.ascontiguousarray((estimator.gain * estimator.sigma_mm).T / unit, dtype=np.float32)
    moments = Moments(np.zeros(centre.size))
    buffer = np.empty((max(1, min(trials, CHUNK_VALUES // n)), n), dtype=np.float32)
    done = 0
    while done < trials:
        drawn = buffer[: min(len(buffer), trials - done)]
        noise.fill(rng, drawn)
        moments.add((drawn @ scaled).astype(np.float64))  # linear: what the noise adds to the estimate of the undisturbed readings
        done += len(drawn)
    return TrialStatistics(centre + unit * moments.mean, moments.covariance * np.outer(unit, unit), moments.count)
