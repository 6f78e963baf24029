"""Errors of distances between two points of a part. These are the machine's errors as its user sees them; no rigid motion changes them.

A comparison of these errors without and with a compensation table judges the table.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.geometry.bases import Term
from abbe.models.geometry.chain import design
from abbe.models.machine import Machine

if TYPE_CHECKING:
    from abbe.models.solvers.joint import JointSolution
    from abbe.models.uncertainty.sources import ErrorSources

Correction = Callable[[F2], F2]
"""Function of commanded positions (n, 3), mm, that returns the corrections to be added to them, shape (n, 3), mm."""


INNER_SHARE = 0.8
"""Share of each stroke, about its middle, in which distances are judged."""
PAIRS = 2000
SEED = 230  # fixed, so that a solution always gives the same figures


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of positions, mm, shape (n, 3) each."""

    first_mm: F2
    second_mm: F2

    @property
    def unit(self) -> F2:
        """Unit vectors from first to second, shape (n, 3)."""
        gap = self.second_mm - self.first_mm
        return np.asarray(gap / np.linalg.norm(gap, axis=1, keepdims=True))

    def error_mm(self, first: F2, second: F2) -> F1:
        """Return the error of each distance, actual minus nominal, mm, shape (n,), from the deviations at both ends (not linearised)."""
        gap = self.second_mm - self.first_mm
        off = second - first
        length = np.linalg.norm(gap, axis=1)
        # (|g + o| - |g|) without subtracting two long lengths
        return np.asarray((2.0 * (gap * off).sum(axis=1) + (off * off).sum(axis=1)) / (np.linalg.norm(gap + off, axis=1) + length))


def inner_box_mm(machine: Machine, share: float = INNER_SHARE) -> F2:
    """Return the box with a ``share`` of each stroke about its middle, shape (3, 2)."""
    half = 0.5 * share * machine.length_mm
    return np.stack([machine.centre_mm - half, machine.centre_mm + half], axis=1)


def random_pairs(box_mm: F2, n: int = PAIRS, seed: int = SEED) -> Pairs:
    """Draw n pairs of independent, uniformly distributed positions in a box, shape (3, 2)."""
    rng = np.random.default_rng(seed)
    first, second = rng.uniform(box_mm[:, 0], box_mm[:, 1], (2, n, 3))
    return Pairs(first, second)


@dataclass(frozen=True, slots=True)
class DistanceStatistics:
    """Rms, 95 % quantile and maximum of the absolute distance errors over the pairs, mm."""

    rms_mm: float
    q95_mm: float
    max_mm: float


def figures(error_mm: F1) -> DistanceStatistics:
    """Return the statistics of distance errors, shape (n,)."""
    size = np.abs(error_mm)
    return DistanceStatistics(float(np.sqrt(np.mean(size**2))), float(np.quantile(size, 0.95)), float(size.max()))


@dataclass(frozen=True, slots=True)
class PredictedDistances:
    """Predicted statistics of the distance errors over the inner volume, each with its standard uncertainty, mm.

    Each value is the mean over random draws of the deviation field from all sources of its uncertainty (noise, set-ups, typical sizes,
    higher orders, wavelength, temperatures; `abbe.models.uncertainty.sources`); its uncertainty is the scatter of the draws.
    ``known_mm``: rms of the known error that remains; ``unknown_mm``: rms of the unknown error, which no table can remove.
    """

    rms_mm: float
    u_rms_mm: float
    q95_mm: float
    u_q95_mm: float
    max_mm: float
    u_max_mm: float
    known_mm: float
    unknown_mm: float


def pair_design(machine: Machine, terms: tuple[Term, ...], pairs: Pairs) -> F2:
    """Return the error of each distance per unit of every coefficient, shape (n, terms)."""
    both = [np.einsum("ni,nik->nk", pairs.unit, design(machine, terms, p)) for p in (pairs.first_mm, pairs.second_mm)]
    return np.asarray(both[1] - both[0])


def correction_error_mm(correction: Correction, pairs: Pairs) -> F1:
    """Return the change of each distance by a correction, mm, shape (n,)."""
    return np.asarray(np.einsum("ni,ni->n", pairs.unit, correction(pairs.second_mm) - correction(pairs.first_mm)))


def predict_distances(
    solution: JointSolution,
    correction: Correction | None = None,
    *,
    pairs: Pairs | None = None,
    sources: ErrorSources | None = None,
    draws: int = 200,
) -> PredictedDistances:
    """Predict the distance errors of the identified machine, without or with a correction.

    The prediction is of first order: a correction also shifts the position at which the machine's error acts, and so changes the error by
    its slope times the correction (0.0001 x 50 um = 5 nm). This change is neglected.

    Parameters
    ----------
    correction : Correction, optional
        Default: the machine as it is.
    pairs : Pairs, optional
        Default: `PAIRS` fixed random pairs in the inner 80 % of every stroke.
    sources : ErrorSources, optional
        Sources of uncertainty; default: ``error_sources(solution)``, with the documented inputs.
    draws : int
        Number of random draws of the field, with a fixed seed.
    """
    from abbe.models.uncertainty.sources import approach_variance_mm2, error_sources, joint_factor

    pairs = pairs or random_pairs(inner_box_mm(solution.machine))
    sources = sources or error_sources(solution)
    a = pair_design(solution.machine, sources.terms, pairs)
    known = a @ sources.coefficients
    if correction is not None:
        known = known + correction_error_mm(correction, pairs)
    root, rng = joint_factor(sources, a), np.random.default_rng(SEED)
    drawn = root @ rng.standard_normal((root.shape[1], draws))
    approach = 2.0 * approach_variance_mm2(sources)  # both ends of a distance
    if approach:
        drawn += np.sqrt(approach) * rng.standard_normal(drawn.shape)
    return _summed(known, drawn, float(np.sqrt(np.mean(np.sum(root**2, axis=1)) + approach)))


def _summed(known: F1, drawn: F2, unknown_mm: float) -> PredictedDistances:
    """Return the statistics of the sum of the known error, shape (n,), and each draw of the unknown error, shape (n, draws)."""
    size = np.abs(known[:, None] + drawn)
    rms, q95, largest = np.sqrt(np.mean(size**2, axis=0)), np.quantile(size, 0.95, axis=0), size.max(axis=0)
    return PredictedDistances(
        rms_mm=float(rms.mean()),
        u_rms_mm=float(rms.std()),
        q95_mm=float(q95.mean()),
        u_q95_mm=float(q95.std()),
        max_mm=float(largest.mean()),
        u_max_mm=float(largest.std()),
        known_mm=float(np.sqrt(np.mean(known**2))),
        unknown_mm=unknown_mm,
    )
