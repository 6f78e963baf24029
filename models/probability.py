"""Distribution functions of normal, Student's t, chi-square and F variables, straight from ``scipy.special``.

``scipy.stats`` has the same functions, but its import costs every command most of a second of processor time.
``..._below(x)`` is the probability of a smaller value, ``..._above(x)`` that of a larger one; ``..._quantile(p)`` is the value with
probability p below it, ``..._limit(p)`` the value with probability p above it. Arguments may be arrays; for t, degrees of freedom may be
infinite.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import ArrayLike

from abbe.models.arrays import F1


def normal_below(z: ArrayLike) -> F1:
    """Return the probability that a standard normal variable is below ``z``."""
    return np.asarray(scipy.special.ndtr(z))


def normal_above(z: ArrayLike) -> F1:
    """Return the probability that a standard normal variable is above ``z``."""
    return np.asarray(scipy.special.ndtr(-np.asarray(z, dtype=float)))


def normal_limit(p: ArrayLike) -> F1:
    """Return the value above which a standard normal variable lies with probability ``p``; inf for p = 0."""
    return np.asarray(-scipy.special.ndtri(p))


def t_quantile(p: ArrayLike, dof: ArrayLike) -> F1:
    """Return the quantile of Student's t; with infinite ``dof``, that of the normal distribution."""
    many = np.isinf(dof)
    return np.asarray(np.where(many, scipy.special.ndtri(p), scipy.special.stdtrit(np.where(many, 1.0, dof), p)))


def t_above(t: ArrayLike, dof: ArrayLike) -> F1:
    """Return the probability that Student's t is above ``t``; with infinite ``dof``, that of the normal distribution."""
    many, lower = np.isinf(dof), -np.asarray(t, dtype=float)
    return np.asarray(np.where(many, scipy.special.ndtr(lower), scipy.special.stdtr(np.where(many, 1.0, dof), lower)))


def chi2_quantile(p: ArrayLike, dof: ArrayLike) -> F1:
    """Return the value below which chi-square lies with probability ``p``."""
    return np.asarray(2.0 * scipy.special.gammaincinv(0.5 * np.asarray(dof, dtype=float), p))


def chi2_above(x: ArrayLike, dof: ArrayLike) -> F1:
    """Return the probability that chi-square is above ``x``; 1 for x <= 0."""
    return np.asarray(scipy.special.chdtrc(dof, np.maximum(x, 0.0)))


def f_above(x: ArrayLike, dof: ArrayLike, dof_below: ArrayLike) -> F1:
    """Return the probability that F is above ``x``; 1 for x <= 0."""
    return np.asarray(scipy.special.fdtrc(dof, dof_below, np.maximum(x, 0.0)))


def f_limit(p: ArrayLike, dof: ArrayLike, dof_below: ArrayLike) -> F1:
    """Return the value above which F lies with probability ``p``."""
    half, half_below = 0.5 * np.asarray(dof, dtype=float), 0.5 * np.asarray(dof_below, dtype=float)
    # rest = 1 - share, computed on its own: the subtraction would lose digits where rest is small.
    share, rest = scipy.special.betainccinv(half, half_below, p), scipy.special.betaincinv(half_below, half, p)
    return np.asarray(half_below * share / (half * rest))
