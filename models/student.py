"""Student's t without ``scipy.special``, whose import costs a quarter of the processor time of a command that computes a trend.

The probability is an incomplete beta function, computed by its continued fraction (Lentz's method), so that tails keep their digits.
"""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike

from abbe.models.arrays import F1

ROUNDS = 1000
"""Most steps of the continued fraction; it needs about the square root of the degrees of freedom."""
TINY = 1e-300


def normal_limit(p: ArrayLike) -> F1:
    """Return the value above which a standard normal variable lies with probability ``p``; inf for p = 0, -inf for p = 1."""
    values = np.asarray(p, dtype=float)
    normal, ends = NormalDist(), {0.0: np.inf, 1.0: -np.inf}
    found = [ends[one] if one in ends else -normal.inv_cdf(one) for one in values.ravel().tolist()]
    return np.array(found, dtype=float).reshape(values.shape)


def t_above(t: ArrayLike, dof: ArrayLike) -> F1:
    """Return the probability that Student's t is above ``t``; with infinite ``dof``, that of the normal distribution.

    ``dof`` is positive. The relative error is below 1e-12 up to 4000 degrees of freedom, and below 1e-10 up to a million.
    """
    size, free = np.broadcast_arrays(np.asarray(t, dtype=float), np.asarray(dof, dtype=float))
    tail = np.empty(size.shape)
    many = np.isinf(free)
    tail[many] = [0.5 * math.erfc(one / math.sqrt(2.0)) for one in np.abs(size[many]).tolist()]
    tail[~many] = _tail(np.abs(size[~many]), free[~many])
    return np.asarray(np.where(size < 0, 1.0 - tail, tail))


def t_limit(p: float, dof: float) -> float:
    """Return the value above which Student's t lies with probability ``p`` (between 0 and 0.5); ``dof`` is positive and finite."""
    t = float(normal_limit(p))  # below the limit sought, where the tail is convex: Newton's steps come from one side
    log_scale = -0.5 * math.log(dof * math.pi) - float(_log_ratio(np.array([0.5 * dof]))[0])
    for _ in range(ROUNDS):
        above = float(t_above(t, dof))
        step = above * math.log(above / p) / math.exp(log_scale - 0.5 * (dof + 1.0) * math.log1p(t * t / dof))
        t += step
        if abs(step) < 1e-14 * t:
            break
    return t


def f_limit_2(p: float, dof_below: float) -> float:
    """Return the value above which F with 2 and ``dof_below`` degrees of freedom lies with probability ``p``: a closed form."""
    return 0.5 * dof_below * math.expm1(-2.0 * math.log(p) / dof_below)


def _tail(t: F1, dof: F1) -> F1:
    """Probability above t >= 0: half the incomplete beta function of (dof / 2, 1 / 2) at dof / (dof + t²)."""
    a, b = 0.5 * dof, np.full_like(dof, 0.5)
    square = t * t / dof
    x, y = 1.0 / (1.0 + square), np.where(np.isinf(square), 1.0, square / (1.0 + np.where(np.isinf(square), 1.0, square)))
    with np.errstate(divide="ignore"):
        log_power = -a * np.log1p(square) + b * np.log(y) - 0.5 * math.log(math.pi) - _log_ratio(a)
    far = x < (a + 1.0) / (a + b + 2.0)
    power = np.exp(np.where(np.isneginf(log_power), -np.inf, log_power))
    one = power * _fraction(np.where(far, a, b), np.where(far, b, a), np.where(far, x, y)) / np.where(far, a, b)
    return np.asarray(np.where(far, 0.5 * one, 0.5 - 0.5 * one))


def _log_ratio(a: F1) -> F1:
    """Logarithm of gamma(a) / gamma(a + 1/2); by its series where the difference of two logarithms would lose digits."""
    small = [math.lgamma(one) - math.lgamma(one + 0.5) if one < 20.0 else 0.0 for one in a.tolist()]
    s = 1.0 / (a * a)
    series = -0.5 * np.log(a) + (1 / 8 - s * (1 / 192 - s * (1 / 640 - s * (17 / 14336 - s * 31 / 18432)))) / a
    return np.where(a < 20.0, small, series)


def _fraction(a: F1, b: F1, x: F1) -> F1:
    """Continued fraction of the incomplete beta function by Lentz's method."""
    c, d = np.ones_like(x), _away(1.0 - (a + b) * x / (a + 1.0))
    d = 1.0 / d
    found = d
    for m in range(1, ROUNDS):
        for k in (m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m)), -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1))):
            d, c = 1.0 / _away(1.0 + k * d), _away(1.0 + k / c)
            found = found * (d * c)
        if bool((np.abs(d * c - 1.0) < 1e-15).all()):
            break
    return np.asarray(found)


def _away(value: F1) -> F1:
    """The value, kept away from zero."""
    return np.asarray(np.where(np.abs(value) < TINY, TINY, value))
