"""Monte Carlo of the non-linear helix: least squares on the exact bar length, all trials at once.

The tip stands at M d - c, M = 1 + E with the six linear parameters, d from the nominal to the commanded point, c the cup's offset. Its
distance squared is a polynomial of degree two in d, so distances of all trials are one matrix product with ten monomials, and the gradient
of the sum of squares is another one. The step uses the normal matrix of the mean trial: trials differ from it by parts in 10^5, and the
gradient is exact, so what the iteration settles on is each trial's own least-squares solution. What does not settle gets Gauss-Newton with
its own Jacobian.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from abbe.models.arrays import F1, F2, F3
from abbe.models.solvers.helix import LINEAR, SETUP, linear_field
from abbe.models.uncertainty.distributions import NORMAL, Distribution, Moments

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


SETTLED = 1e-7
"""A trial has converged when its last step is below this many standard uncertainties in every parameter."""
FAST_STEPS, SLOW_STEPS = 8, 40
_FIRST, _SECOND = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])
_E_ROW, _E_COLUMN, _E_SIGN = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2]), np.array([1.0, 1, 1, -1, 1, -1])


@dataclass(frozen=True)
class HelixFits:
    """Fits of many trials: theta (trials, 6 or 10), in the order of `names`; which of them converged, shape (trials,)."""

    names: tuple[str, ...]
    theta: F2
    converged: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]


@dataclass(frozen=True)
class HelixTask:
    """One ball-bar run to be solved again and again, six (perfect mounting) or ten unknowns (`abbe.models.solvers.helix`).

    Attributes
    ----------
    d_mm : array, shape (n, 3)
        Commanded points relative to the nominal cup.
    radius_mm, sigma_mm : float
        Nominal bar length; standard uncertainty of one reading.
    u_length_mm : float, optional
        Prior standard deviation of the bar length: ten unknowns. None: six.

    Raises
    ------
    ValueError
        Fewer points than unknowns, points that do not tell the unknowns apart (a plane circle), or a figure that is not positive.
    """

    d_mm: F2
    radius_mm: float
    sigma_mm: float
    u_length_mm: float | None = None

    def __post_init__(self) -> None:
        """Refuse what cannot be solved."""
        if self.d_mm.ndim != 2 or self.d_mm.shape[1] != 3 or len(self.d_mm) < len(self.names):
            raise ValueError(f"helix trials: points of shape {self.d_mm.shape} cannot carry {len(self.names)} unknowns")
        if not (self.radius_mm > 0 and self.sigma_mm > 0) or (self.u_length_mm is not None and not self.u_length_mm > 0):
            raise ValueError("helix trials: radius, sigma and length uncertainty must be positive")
        if not np.isfinite(self.d_mm).all():
            raise ValueError("helix trials: points must be finite")
        j = self.jacobian(np.zeros((1, len(self.names))))[1][0]
        size = np.linalg.norm(j, axis=0)
        told = np.linalg.matrix_rank(j / np.where(size > 0, size, 1.0), tol=1e-9)
        if told < len(self.names) - (self.u_length_mm is not None):  # the bar's length has its calibration
            raise ValueError(f"helix trials: the points tell only {told} of {len(self.names)} unknowns apart, as those of a plane circle")

    @property
    def names(self) -> tuple[str, ...]:
        """Unknowns: EXX.1 to A0Z, then cup offset and bar length."""
        return LINEAR if self.u_length_mm is None else LINEAR + SETUP

    @property
    def length_weight(self) -> float:
        """Weight of the prior of the bar length in units of that of a reading."""
        return 0.0 if self.u_length_mm is None else (self.sigma_mm / self.u_length_mm) ** 2

    def jacobian(self, theta: F2) -> tuple[F2, F3]:
        """Reading of each trial and its derivative, shapes (trials, n) and (trials, n, p), written out plainly."""
        field = linear_field(self.d_mm)
        tip = self.d_mm + np.einsum("nik,tk->tni", field, theta[:, :6])
        if self.u_length_mm is not None:
            tip = tip - theta[:, None, 6:9]
        length = np.linalg.norm(tip, axis=2)
        normal = tip / length[:, :, None]
        columns = [np.einsum("tni,nik->tnk", normal, field)]
        if self.u_length_mm is not None:
            columns += [-normal, np.ones((*length.shape, 1))]
            length = length + theta[:, 9:10]
        return length - self.radius_mm, np.concatenate(columns, axis=2)


def fit_trials(task: HelixTask, readings_mm: F2, length_mm: F1 | None = None) -> HelixFits:
    """Least-squares solution of every trial.

    Parameters
    ----------
    task : HelixTask
    readings_mm : array, shape (trials, n)
        Bar length minus radius.
    length_mm : array, shape (trials,), optional
        Bar length error that each trial's calibration states (ten unknowns); default: 0, the calibration is right.

    Returns
    -------
    HelixFits, in the order of the trials; ``converged`` is False where neither way settled.

    Raises
    ------
    ValueError
        Readings of another shape, none at all, or not finite (names the trial: one of them would spoil the start of all).
    """
    readings = np.asarray(readings_mm, dtype=np.float64)
    if readings.ndim != 2 or readings.shape[1] != len(task.d_mm) or not len(readings):
        raise ValueError(f"helix trials: readings of shape {readings.shape} do not fit {len(task.d_mm)} points")
    bad = np.flatnonzero(~np.isfinite(readings).all(axis=1))
    if bad.size:
        raise ValueError(f"helix trials: trial {bad[0]} (and {bad.size - 1} more) holds readings that are not finite")
    readings, stated = _about_calibration(task, readings, length_mm)
    start, _ = _gauss_newton(task, readings.mean(axis=0)[None], np.zeros((1, len(task.names))))
    theta = np.empty((len(readings), len(task.names)))
    converged = np.empty(len(readings), dtype=np.bool_)
    size = max(1, CHUNK_VALUES // (2 * len(task.d_mm)))
    fast = _Fast(task, start[0])
    for i in range(0, len(readings), size):
        theta[i : i + size], converged[i : i + size] = fast.solve(readings[i : i + size])
    left = np.flatnonzero(~converged)
    for i in range(0, left.size, 1000):
        part = left[i : i + 1000]
        theta[part], converged[part] = _gauss_newton(task, readings[part], np.repeat(start, part.size, axis=0))
    theta[:, 9:] += stated[:, None]
    return HelixFits(task.names, theta, converged)


def _about_calibration(task: HelixTask, readings: F2, length_mm: F1 | None) -> tuple[F2, F1]:
    """Readings as if the calibrated length were right, and what to give back to the bar length afterwards."""
    if length_mm is None:
        return readings, np.zeros(len(readings))
    if task.u_length_mm is None or length_mm.shape != (len(readings),):
        raise ValueError("helix trials: length_mm needs ten unknowns and one value per trial")
    return readings - length_mm[:, None], length_mm


def helix_trials(
    task: HelixTask, readings_mm: F1, rng: np.random.Generator, trials: int, *, noise: Distribution = NORMAL
) -> TrialStatistics:
    """Mean and covariance of the estimates when the run is measured again and again.

    The readings scatter about ``readings_mm``, shape (n,); with ten unknowns every trial has a calibration of the bar of its own, wrong by
    ``task.u_length_mm`` (normal). The seed decides everything; chunks keep the memory small.
    """
    moments: Moments | None = None
    buffer = np.empty((max(1, min(trials, CHUNK_VALUES // len(task.d_mm))), len(task.d_mm)))
    done = 0
    while done < trials:
        drawn = buffer[: min(len(buffer), trials - done)]
        noise.fill(rng, drawn)
        drawn *= task.sigma_mm
        drawn += readings_mm
        stated = None if task.u_length_mm is None else rng.normal(0.0, task.u_length_mm, len(drawn))
        fits = fit_trials(task, drawn, stated)
        moments = moments or Moments(fits.theta[0].copy())
        moments.add(fits.theta[fits.converged])
        done += len(drawn)
    if moments is None:
        raise ValueError("helix trials: no trials asked for")
    return TrialStatistics(moments.mean, moments.covariance, moments.count, trials - moments.count)


class _Fast:
    """Gauss-Newton with one normal matrix for all trials and the exact gradient of each; lengths in units of the bar."""

    def __init__(self, task: HelixTask, start: F1) -> None:
        self.task, self.start = task, start
        d = task.d_mm / task.radius_mm
        squares = d[:, _FIRST] * d[:, _SECOND]
        self.mono = np.ascontiguousarray(np.concatenate([squares, d, np.ones((len(d), 1))], axis=1).T)
        if task.u_length_mm is None:
            self.mono = self.mono[:6].copy()
        self.unit = np.r_[np.ones(6), np.full(len(start) - 6, task.radius_mm)]  # of each unknown in the scaled problem
        j = task.jacobian(start[None])[1][0] * self.unit / task.radius_mm
        normal = j.T @ j
        if task.u_length_mm is not None:
            normal[9, 9] += task.length_weight
        self.inverse = np.linalg.inv(normal)
        self.u = np.sqrt(np.diag(self.inverse)) * task.sigma_mm / task.radius_mm

    def solve(self, readings: F2) -> tuple[F2, np.ndarray[tuple[int, ...], np.dtype[np.bool_]]]:
        """Estimates and whether each trial's last step was small."""
        y = readings / self.task.radius_mm
        theta = np.repeat((self.start / self.unit)[None], len(y), axis=0)
        settled = np.zeros(len(y), dtype=np.bool_)
        for _ in range(FAST_STEPS):
            step = self._gradient(theta, y) @ self.inverse
            theta += step
            settled = (np.abs(step) < SETTLED * self.u).all(axis=1)
            if settled.all():
                break
        return theta * self.unit, settled

    def _gradient(self, theta: F2, y: F2) -> F2:
        """J^T (observed - predicted) of every trial, minus the pull of the prior, shape (trials, p)."""
        m = np.zeros((len(theta), 3, 3))
        m[:, _E_ROW, _E_COLUMN] = theta[:, :6] * _E_SIGN
        m += np.eye(3)
        c, bar = theta[:, 6:9], theta[:, 9:]
        gram = np.swapaxes(m, 1, 2) @ m
        square = [gram[:, _FIRST, _SECOND] * np.array([1.0, 1, 1, 2, 2, 2])]
        if c.size:
            square += [-2.0 * (c[:, None] @ m)[:, 0], (c**2).sum(axis=1, keepdims=True)]
        length = np.concatenate(square, axis=1) @ self.mono
        np.sqrt(length, out=length)
        left = y + 1.0
        left -= length
        if not c.size:
            left /= length
            return self._of_errors(m, left @ self.mono.T)
        left -= bar
        g_bar = left.sum(axis=1, keepdims=True) - self.task.length_weight * bar
        left /= length
        sums = left @ self.mono.T
        first = sums[:, 6:9]
        g_e = self._of_errors(m, sums) - (c[:, :, None] * first[:, None])[:, _E_ROW, _E_COLUMN] * _E_SIGN
        return np.concatenate([g_e, c * sums[:, 9:] - (m @ first[:, :, None])[:, :, 0], g_bar], axis=1)

    @staticmethod
    def _of_errors(m: F3, sums: F2) -> F2:
        """Gradient for the six linear parameters: entries of M times the second moments, with the papers' signs."""
        second = sums[:, [0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(-1, 3, 3)
        return np.asarray((m @ second)[:, _E_ROW, _E_COLUMN] * _E_SIGN)


def _gauss_newton(task: HelixTask, readings: F2, theta: F2) -> tuple[F2, np.ndarray[tuple[int, ...], np.dtype[np.bool_]]]:
    """Gauss-Newton with each trial's own Jacobian."""
    settled = np.zeros(len(readings), dtype=np.bool_)
    prior = np.zeros(theta.shape[1])
    prior[9:] = task.length_weight
    for _ in range(SLOW_STEPS):
        predicted, j = task.jacobian(theta)
        transposed = np.swapaxes(j, 1, 2)
        inverse = np.linalg.inv(transposed @ j + np.diag(prior))
        step = (inverse @ ((transposed @ (readings - predicted)[:, :, None])[:, :, 0] - prior * theta)[:, :, None])[:, :, 0]
        theta = theta + step
        u = task.sigma_mm * np.sqrt(np.einsum("tii->ti", inverse))
        settled = (np.abs(step) < SETTLED * u).all(axis=1)
        if settled.all():
            break
    return theta, settled
