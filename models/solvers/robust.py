"""Outliers: readings that noise does not explain are down-weighted or rejected, and listed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from abbe.models.arrays import F1, F2

FALSE_ALARM = 0.05
"""Chance that a campaign without any outlier has a reading that counts less."""
REJECT = 1.5
"""From this multiple of the threshold on a reading counts nothing."""


@dataclass(frozen=True, slots=True)
class Outlier:
    """A reading that counts less: its run, its index in the run's values, its size in standard deviations, its weight 0 to 1."""

    run: str
    index: int
    size: float
    weight: float


def leverage(a: F2, root: F2) -> F1:
    """Share of each reading's variance that the fit takes, shape (n,): squared length of the rows of ``a @ root.T``.

    Parameters
    ----------
    a : array, shape (n, p)
        Whitened design.
    root : array, shape (p, p)
        ``root.T @ root`` is the covariance of the unknowns.
    """
    z = a @ root.T
    return np.asarray(np.einsum("np,np->n", z, z))


def threshold(n: int) -> float:
    """Size in standard deviations that ``n`` normal readings exceed with the chance `FALSE_ALARM` only; never below 3.5."""
    return max(3.5, float(-special.ndtri(0.5 * FALSE_ALARM / max(n, 1))))


def weights(size: F1, limit: float) -> F1:
    """Redescending weights: 1 below the limit, falling to 0 at `REJECT` times the limit (Hampel's third part), shape (n,).

    Clean readings all keep weight 1, so nothing is lost on them and the estimated noise is not biased.
    """
    s: F1 = np.abs(size)
    inside = np.maximum(s, 1e-300)
    return np.asarray(np.where(s <= limit, 1.0, np.clip((REJECT * limit - s) / ((REJECT - 1.0) * inside), 0.0, 1.0)))


def scale(size: F1) -> float:
    """Robust standard deviation (median absolute value), so that outliers do not hide themselves by widening the noise."""
    return float(np.median(np.abs(size)) / 0.6744897501960817) if size.size else 1.0
