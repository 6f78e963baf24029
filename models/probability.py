"""Distribution functions of normal, Student's t, chi-square and F variables, straight from ``scipy.special``.

``scipy.stats`` has the same functions, and takes most of a second of processor time to import: every command and every service paid it.
Names: ``..._below`` is the probability of a smaller value, ``..._above`` of a larger one, ``..._quantile`` the value with that probability
below it, ``..._limit`` the value with that probability above it. Arguments may be arrays; degrees of freedom may be infinite for t.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import ArrayLike

from abbe.models.arrays import F1


def normal_below(z: ArrayLike) -> F1:
    """Probability that a standard normal variable is below ``z``."""
    return np.asarray(scipy.special.ndtr(z))


def normal_above(z: ArrayLike) -> F1:
    """Probability that a standard normal variable is above ``z``."""
    return np.asarray(scipy.special.ndtr(-np.asarray(z, dtype=float)))


def normal_limit(p: ArrayLike) -> F1:
    """Value above which a standard normal variable lies with probability ``p``; inf for 0."""
    return np.asarray(-scipy.special.ndtri(p))


def t_quantile(p: ArrayLike, dof: ArrayLike) -> F1:
    """Quantile of Student's t with ``dof`` degrees of freedom; with infinitely many, that of the normal distribution."""
    many = np.isinf(dof)
    return np.asarray(np.where(many, scipy.special.ndtri(p), scipy.special.stdtrit(np.where(many, 1.0, dof), p)))


def t_above(t: ArrayLike, dof: ArrayLike) -> F1:
    """Probability that Student's t is above ``t``; with infinitely many degrees of freedom, that of the normal distribution."""
    many, lower = np.isinf(dof), -np.asarray(t, dtype=float)
    return np.asarray(np.where(many, scipy.special.ndtr(lower), scipy.special.stdtr(np.where(many, 1.0, dof), lower)))


def chi2_quantile(p: ArrayLike, dof: ArrayLike) -> F1:
    """Quantile of chi-square."""
    return np.asarray(2.0 * scipy.special.gammaincinv(0.5 * np.asarray(dof, dtype=float), p))


def chi2_above(x: ArrayLike, dof: ArrayLike) -> F1:
    """Probability that chi-square is above ``x``; 1 for what is not positive."""
    return np.asarray(scipy.special.chdtrc(dof, np.maximum(x, 0.0)))


def f_above(x: ArrayLike, dof: ArrayLike, dof_below: ArrayLike) -> F1:
    """Probability that F is above ``x``; 1 for what is not positive."""
    return np.asarray(scipy.special.fdtrc(dof, dof_below, np.maximum(x, 0.0)))


def f_limit(p: ArrayLike, dof: ArrayLike, dof_below: ArrayLike) -> F1:
    """Value above which F lies with probability ``p``."""
    half, half_below = 0.5 * np.asarray(dof, dtype=float), 0.5 * np.asarray(dof_below, dtype=float)
    # Share and rest are one, but 1 - share would lose its digits where the rest is small.
    share, rest = scipy.special.betainccinv(half, half_below, p), scipy.special.betaincinv(half_below, half, p)
    return np.asarray(half_below * share / (half * rest))
