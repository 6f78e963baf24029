"""How much more likely readings are if something has changed by an unknown amount: each candidate alone, all else integrated out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from abbe.models.arrays import F1, F2


@dataclass(frozen=True)
class Asked:
    """A candidate: numbers of mean 0 and a standard deviation of ``sizes`` (which one is not known) along ``directions``, shape (p, q).

    ``several``: a motion's shape, however many numbers that takes here; else one number with a meaning of its own.
    """

    name: str
    directions: F2
    sizes: tuple[float, ...]
    several: bool = False


@dataclass(frozen=True)
class Evidence:
    """Gain in log evidence at the best size, and that size."""

    name: str
    gain: float
    size: float


def evidence_of(gram: F2, moment: F1, base: F2, asked: Sequence[Asked]) -> list[Evidence]:
    """Ask every candidate alone.

    Parameters
    ----------
    gram, moment : arrays, shape (p, p) and (p,)
        Normal equations of the whitened readings, less what is expected without any change.
    base : array, shape (p, k)
        Factor of the covariance of everything that is open without a change; it is integrated out.
    asked : sequence of Asked

    Returns
    -------
    list of Evidence
        In the same order. Gain: log of the ratio of marginal likelihoods with and without the candidate.
    """
    inside = base.T @ gram @ base
    inside[np.diag_indices_from(inside)] += 1.0
    low = linalg.cholesky(inside, lower=True)
    half = linalg.solve_triangular(low, base.T @ np.column_stack([gram, moment]), lower=True)
    own = gram - half[:, :-1].T @ half[:, :-1]
    told = moment - half[:, :-1].T @ half[:, -1]
    return [_one(a, own, told) for a in asked]


def log_evidence(gram: F2, moment: F1, base: F2) -> float:
    """Log of the marginal likelihood with everything along ``base`` open; constants that all bases share are left out."""
    inside = base.T @ gram @ base
    inside[np.diag_indices_from(inside)] += 1.0
    low = linalg.cholesky(inside, lower=True)
    z = linalg.solve_triangular(low, base.T @ moment, lower=True)
    return 0.5 * float(z @ z) - float(np.log(low.diagonal()).sum())


def _one(asked: Asked, gram: F2, moment: F1) -> Evidence:
    d = asked.directions
    values, vectors = linalg.eigh(d.T @ gram @ d)
    values, along = np.maximum(values, 0.0), vectors.T @ (d.T @ moment)
    found = []
    for size in asked.sizes:
        inside = 1.0 + size**2 * values
        found.append(0.5 * float(np.sum(size**2 * along**2 / inside) - np.sum(np.log(inside))))
    best = int(np.argmax(found))
    return Evidence(asked.name, found[best], asked.sizes[best])
