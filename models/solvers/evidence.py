"""How probable readings are under a linear model with independent normal priors of unit size: log evidence, alone and given other readings.

Log evidences leave out n log(2 pi) / 2, which all explanations of the same readings share. Source: Rasmussen and Williams, Gaussian
Processes for Machine Learning, 2.2 and 5.4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from abbe.models.arrays import F1, F2

SIGMA_GRID_MM = np.geomspace(1e-6, 1.0, 49)
OUTLIER_SIGMA, OUTLIER_SHARE = 3.5, 0.2
"""A reading that the rest of its run misses by so many standard deviations does not count here; at most this share of a run."""


@dataclass(frozen=True, slots=True)
class Part:
    """One run without its outliers: design in units of the prior and readings, both over the noise; what the units add to the evidence."""

    a: F2
    y: F1
    log_sigma: float

    @property
    def information(self) -> F2:
        """What the run says of the unknowns, shape (p, p), without their prior."""
        return np.asarray(self.a.T @ self.a)


@dataclass(frozen=True, slots=True)
class Posterior:
    """What some parts together say: Cholesky factor of the information with the prior, and its log evidence."""

    factor: F2
    theta: F1
    log_evidence: float


def together(parts: Sequence[Part]) -> Posterior:
    """What some runs say together, and how probable their readings are."""
    n = parts[0].a.shape[1]
    information = sum((p.information for p in parts), np.eye(n))
    lower = linalg.cholesky(information, lower=True)
    half = linalg.solve_triangular(lower, sum((p.a.T @ p.y for p in parts), np.zeros(n)), lower=True)
    theta = linalg.solve_triangular(lower, half, lower=True, trans=1)
    left = sum(float(p.y @ p.y) for p in parts) - float(half @ half)
    log_p = -0.5 * left - float(np.log(np.diag(lower)).sum()) - sum(p.log_sigma for p in parts)
    return Posterior(lower, theta, log_p)


def conditional(others: Posterior, variants: dict[str, Part]) -> dict[str, float]:
    """Log evidence of each variant of a run given what the others say; variants with one design share its factorisation."""
    out: dict[str, float] = {}
    known: list[tuple[F2, F2, F2]] = []
    for name, part in variants.items():
        found = next((k for k in known if np.array_equal(k[0], part.a)), None)
        if found is None:
            spread = linalg.solve_triangular(others.factor, part.a.T, lower=True).T
            found = (part.a, spread, linalg.cholesky(spread @ spread.T + np.eye(len(spread)), lower=True))
            known.append(found)
        left = linalg.solve_triangular(found[2], part.y - part.a @ others.theta, lower=True)
        out[name] = -0.5 * float(left @ left) - float(np.log(np.diag(found[2])).sum()) - part.log_sigma
    return out


def scatter(a: F2, y: F1) -> tuple[float, NDArray[np.bool_]]:
    """Noise that the model leaves in one run, mm, and which of its readings are outliers, bool, shape (n,).

    The noise is the most probable of `SIGMA_GRID_MM`; each reading is compared with what all others of the run predict.
    """
    drop = np.zeros(y.size, dtype=bool)
    while True:
        sigma, z = _against_the_rest(a[~drop], y[~drop])
        bad = np.abs(z) > OUTLIER_SIGMA
        if not bad.any() or drop.sum() + bad.sum() > OUTLIER_SHARE * drop.size:
            return sigma, drop
        drop[np.flatnonzero(~drop)[bad]] = True


def _against_the_rest(a: F2, y: F1) -> tuple[float, F1]:
    """Most probable noise, and every reading's distance from the prediction of the others in standard deviations.

    Source: Rasmussen and Williams, Gaussian Processes, eqs 5.8 and 5.12.
    """
    values, vectors = linalg.eigh(a @ a.T)
    values, turned = np.clip(values, 0.0, None), vectors.T @ y
    spread = values[:, None] + SIGMA_GRID_MM**2
    log_p = -0.5 * (turned[:, None] ** 2 / spread + np.log(spread)).sum(axis=0)
    sigma = float(SIGMA_GRID_MM[int(np.argmax(log_p))])
    over = 1.0 / (values + sigma**2)
    return sigma, (vectors @ (over * turned)) / np.sqrt((vectors**2) @ over)
