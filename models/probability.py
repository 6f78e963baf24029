"""Distribution functions of normal, Student's t, chi-square and F variables, straight from ``scipy.special``.

``scipy.stats`` has the same functions, but its import costs every command most of a second of processor time.
``..._below(x)`` is the probability of a smaller value, ``..._above(x)`` that of a larger one; ``..._quantile(p)`` is the value with
probability p below it. Arguments may be arrays; for t, degrees of freedom may be infinite. `abbe.models.student` has what a trend needs.
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


def t_quantile(p: ArrayLike, dof: ArrayLike) -> F1:
    """Return the quantile of Student's t; with infinite ``dof``, that of the normal distribution."""
    many = np.isinf(dof)
    return np.asarray(np.where(many, scipy.special.ndtri(p), scipy.special.stdtrit(np.where(many, 1.0, dof), p)))


def chi2_quantile(p: ArrayLike, dof: ArrayLike) -> F1:
    """Return the value below which chi-square lies with probability ``p``."""
    return np.asarray(2.0 * scipy.special.gammaincinv(0.5 * np.asarray(dof, dtype=float), p))


def chi2_above(x: ArrayLike, dof: ArrayLike) -> F1:
    """Return the probability that chi-square is above ``x``; 1 for x <= 0."""
    return np.asarray(scipy.special.chdtrc(dof, np.maximum(x, 0.0)))


def f_above(x: ArrayLike, dof: ArrayLike, dof_below: ArrayLike) -> F1:
    """Return the probability that F is above ``x``; 1 for x <= 0."""
    return np.asarray(scipy.special.fdtrc(dof, dof_below, np.maximum(x, 0.0)))
