"""Repeats of a positioning test: does one slow drift, common to all positions, explain their differences?

Readings at a position approached repeatedly from the same side differ by noise and by drift. A drift in time that is the same at all
positions shows in the repeats alone, without a model of the axis. Correlated noise looks like drift, so the p-value is simulated with noise
that has the residuals' correlation from reading to reading ("memory"), for the best of all forms of drift tried.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy

from abbe.models.arrays import F1, F2

P_LIMIT = 0.005
"""A drift is claimed only below this p-value."""
SHARE_LIMIT = 0.5
"""A claimed drift explains at least this share of the repeat variance; removing less improves repeatability by less than 30 %."""
TAUS = (0.15, 0.3, 0.6, 1.2)
"""Time constants tried, as fractions of the test's duration; a longer one is nearly a straight line."""
TRIALS = 2000
MEMORIES = np.linspace(0.0, 0.96, 25)
LEAST = 3
"""Repeats of a position are used only if it was visited from one side at least this often."""


@dataclass(frozen=True)
class RepeatDrift:
    """A drift common to all positions.

    Attributes
    ----------
    named : whether the drift is reported: p below `P_LIMIT` and share of `SHARE_LIMIT` or more.
    share : part of the variance of the repeats that the drift explains, 0 to 1.
    p : probability that noise with the memory of the residuals gives an equal or larger share.
    form, tau_s : "linear", or "exponential" with its time constant.
    change_mm, u_change_mm : drift from the first to the last reading, with its standard uncertainty.
    before_mm, after_mm : standard deviation of the repeats before and after the drift is removed.
    memory : correlation of the noise of neighbouring readings.
    drift_mm : array, shape (n,): drift since the earliest reading, in the caller's order.
    """

    named: bool
    share: float
    p: float
    form: Literal["linear", "exponential"]
    tau_s: float | None
    change_mm: float
    u_change_mm: float
    before_mm: float
    after_mm: float
    memory: float
    drift_mm: F1


def repeat_drift(place: F1, t_s: F1, reading_mm: F1) -> RepeatDrift | None:
    """Look for a common drift in the repeats of a test.

    Parameters
    ----------
    place : array, shape (n,)
        Number for each reading's position and side; readings with equal numbers are repeats.
    t_s, reading_mm : array, shape (n,)
        Time, s, and deviation, mm, of each reading.

    Returns
    -------
    RepeatDrift or None
        None if too few readings are repeats (`LEAST`), or if they do not spread over time.
    """
    order = np.argsort(t_s, kind="stable")
    groups, which, count = np.unique(place[order], return_inverse=True, return_counts=True)
    keep = count[which] >= LEAST
    if np.count_nonzero(keep) < LEAST + 2 or float(np.ptp(t_s)) <= 0.0:
        return None
    rows = order[keep]
    t, y = t_s[rows], reading_mm[rows]
    means = (which[keep][:, None] == np.arange(groups.size)).astype(np.float64)
    basis = scipy.linalg.orth(means)
    shapes = _shapes((t - t[0]) / float(np.ptp(t)))
    left = shapes - basis @ (basis.T @ shapes)
    size = np.linalg.norm(left, axis=0)
    if float(size[0]) < 1e-9:
        return None
    units = left / size
    r = y - basis @ (basis.T @ y)
    ss = float(r @ r)
    gains = (units.T @ r) ** 2 / max(ss, 1e-300)
    best = _simplest(gains, r.size - basis.shape[1] - 1)
    after = r - units[:, best] * float(units[:, best] @ r)
    memory = _memory(after, np.column_stack([basis, units[:, best]]))
    p = _chance(float(gains.max()), basis, units, memory)
    span, share = float(np.ptp(t)), float(gains[best])
    coefficient, u = _size(r, after, units[:, best], basis.shape[1], memory) / size[best]
    reach = float(shapes[-1, best] - shapes[0, best])
    every = _shapes((t_s - t[0]) / span)[:, best]
    return RepeatDrift(
        named=p < P_LIMIT and share >= SHARE_LIMIT,
        share=share,
        p=p,
        form="linear" if best == 0 else "exponential",
        tau_s=None if best == 0 else TAUS[best - 1] * span,
        change_mm=float(coefficient) * reach,
        u_change_mm=float(u) * abs(reach),
        before_mm=float(np.sqrt(ss / (r.size - basis.shape[1]))),
        after_mm=float(np.sqrt(after @ after / max(r.size - basis.shape[1] - 1, 1))),
        memory=memory,
        drift_mm=float(coefficient) * (every - every[int(np.argmin(t_s))]),
    )


def _size(r: F1, after: F1, unit: F1, places: int, memory: float) -> F1:
    """Return the drift's coefficient for a column of unit length and its standard uncertainty under noise with memory, shape (2,)."""
    noise = float(after @ after) / max(r.size - places - 1, 1)
    return np.array([float(unit @ r), float(np.sqrt(noise * (unit @ _correlation(r.size, memory) @ unit)))])


def _correlation(n: int, memory: float) -> F2:
    return np.asarray(memory ** np.abs(np.subtract.outer(np.arange(n), np.arange(n))), dtype=np.float64)


def _shapes(x: F1) -> F2:
    """Return all forms of drift at times x, 0 to 1: a straight line and exponentials, shape (n, forms)."""
    return np.column_stack([x, *((1.0 - np.exp(-x / tau)) for tau in TAUS)])


def _simplest(gains: F1, dof: int) -> int:
    """Return the index of the straight line, or of the best exponential if it is significantly better (F at 1 %, about 7)."""
    best = int(np.argmax(gains))
    left, straight = 1.0 - float(gains[best]), 1.0 - float(gains[0])
    return best if (straight - left) * max(dof - 1, 1) > 7.0 * left else 0


def _memory(residual: F1, taken: F2) -> float:
    """Estimate the memory of the noise from the correlation of neighbouring residuals after the fit, plus two standard errors.

    Without the margin, noise with a memory of 0.8 was called a drift in 3 of 100 tests, because the fitted drift absorbs memory.
    """
    n, ss = residual.size, float(residual @ residual)
    if ss <= 0.0:
        return 0.0
    observed = float(residual[1:] @ residual[:-1]) / ss
    q = scipy.linalg.orth(taken)
    project = np.eye(n) - q @ q.T
    expected = []
    for memory in MEMORIES:
        cov = project @ _correlation(n, float(memory)) @ project
        expected.append(float(np.trace(cov, offset=1) / np.trace(cov)))
    found = float(np.interp(observed, expected, MEMORIES))
    return min(found + 2.0 * float(np.sqrt((1.0 - found**2) / n)), float(MEMORIES[-1]))


def _chance(gain: float, basis: F2, units: F2, memory: float) -> float:
    """Probability that some form of drift explains an equal or larger share of noise with this memory."""
    rng = np.random.default_rng(20261121)
    n = basis.shape[0]
    root = scipy.linalg.cholesky(_correlation(n, memory), lower=True)
    noise = root @ rng.standard_normal((n, TRIALS))
    noise -= basis @ (basis.T @ noise)
    best = ((units.T @ noise) ** 2).max(axis=0) / np.einsum("ij,ij->j", noise, noise)
    return float((1 + np.count_nonzero(best >= gain)) / (1 + TRIALS))
