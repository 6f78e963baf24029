"""Search for periods of screws in points of artefacts: one period or two at once, on one axis or on all.

The data are the displacements at the positions of the axes, with all other unknowns of the solution integrated out. Every period is
judged by the evidence of a sine and a cosine plus a scatter from position to position, whose size is integrated out as well. Two periods
are searched together: in a search for one alone, the other is scatter, and an alias may fit best, because features stand at multiples of
a pitch. The result is a probability for every frequency.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2
from abbe.models.solvers.artefact import PRIORS, Fine
from abbe.models.solvers.engine import CampaignFit, CampaignProblem

PERIODS_MM = (4.0, 60.0)
"""Range of the searched periods."""
LEADS_MM = (5.0, 6.0, 8.0, 10.0, 12.0, 16.0, 20.0, 25.0, 32.0, 40.0)
USUAL, SMOOTH, ALL_AXES, TWO = 0.7, 0.3, 0.7, 0.3
"""Prior probabilities: `USUAL` that a period is the lead of a usual screw, `SMOOTH` that there is no period, `ALL_AXES` that all axes have
the same one. One period has the weight (1 - `TWO`) (1 - `SMOOTH`), two have `TWO` (1 - `SMOOTH`)^2; the posterior is normalised."""
LEAST = 0.05
"""Least probability of a period that enters the model."""
COARSE, FINE, NEAR = 0.3, 0.06, 2
"""Steps of the searched frequencies times the length of the positions: `COARSE` for pairs, `FINE` near the best pairs; `NEAR`: half width
of their neighbourhood in fine steps."""
APART = 4
"""Least number of coarse steps between the two periods of a pair: closer periods are one period with a changing amplitude."""
LIKELY, MOST = 60, 700
"""`LIKELY`: number of pairs whose neighbourhood is searched finely. `MOST`: largest number of coarse frequencies that form pairs: those
with the best evidence alone.
"""
BLOCK = 16
"""Number of first frequencies of pairs that are taken at once; their arrays stay in the cache."""
SCATTER_MM = tuple(float(v) for v in np.geomspace(3e-5, 4e-3, 9))
"""Standard deviations of the scatter from position to position that are tried, equally probable."""

Pair = tuple[NDArray[np.intp], NDArray[np.intp]]


@dataclass(frozen=True)
class Peak:
    """A probable period of some axes: frequency with standard uncertainty, 1/mm, and probability."""

    axes: tuple[int, ...]
    frequency: float
    u_frequency: float
    weight: float


@dataclass(frozen=True)
class Displacements:
    """Log likelihood of the displacements d at positions of the axes by the readings: ``h @ d - d @ information @ d / 2``, mm.

    ``axis``, ``at_mm``: axis and position of every displacement, shape (n,).
    """

    axis: NDArray[np.intp]
    at_mm: F1
    h: F1
    information: F2

    @classmethod
    def of(cls, problem: CampaignProblem, fit: CampaignFit, places: Sequence[Fine]) -> Displacements:
        """Take the displacements from a solution that has these places as unknowns: their posterior without their prior."""
        at = np.array([problem.names.index(p.name) for p in places])
        kind = problem.readings.kind
        weight = fit.weight * np.exp(-fit.components.eta)[kind] / fit.decimation[kind]
        scale = fit.sizes.typical[at] * fit.components.half(fit.sizes)[at]
        columns = problem.readings.a[:, at] * (scale / fit.sizes.typical[at])
        mean = columns.T @ (weight * fit.residual_mm / problem.sigma)  # at the optimum the gradient equals the prior's
        precision = np.linalg.inv(fit.posterior.cov[np.ix_(at, at)])
        values, vectors = np.linalg.eigh(precision - np.eye(at.size))
        known = (vectors * np.maximum(values, 0.0)) @ vectors.T
        axis, at_mm = np.array([p.axis for p in places]), np.array([p.at_mm for p in places])
        return cls(axis, at_mm, precision @ mean / scale, known / np.outer(scale, scale))

    @property
    def span_mm(self) -> float:
        """Longest extent of the positions along an axis."""
        return float(max(np.ptp(self.at_mm[self.axis == a]) for a in set(self.axis.tolist())))

    def waves(self, axes: tuple[int, ...], frequency: F1) -> NDArray[np.float64]:
        """Displacements by a cosine and a sine of each axis, in units of their prior, shape (frequencies, n, 2 axes)."""
        turn = 2.0 * np.pi * frequency[:, None] * self.at_mm
        pair = PRIORS.wave_mm * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        return np.concatenate([pair * (self.axis == a)[:, None] for a in axes], axis=-1)

    def beside(self, scatter_mm: float) -> tuple[F1, F2, float]:
        """The likelihood after an independent scatter of every displacement is integrated out, and its log evidence."""
        whole = np.eye(self.h.size) + scatter_mm**2 * self.information
        h, information = np.linalg.solve(whole, self.h), np.linalg.solve(whole, self.information)
        evidence = 0.5 * scatter_mm**2 * self.h @ h - 0.5 * np.linalg.slogdet(whole)[1]
        return np.asarray(h), 0.5 * (information + information.T), float(evidence)


def peaks(data: Displacements) -> tuple[Peak, ...]:
    """Return the probable periods."""
    frequency = np.arange(1.0 / PERIODS_MM[1], 1.0 / PERIODS_MM[0], FINE / data.span_mm)
    log_prior = np.log(_prior(frequency, data.span_mm))
    levels = [data.beside(s) for s in SCATTER_MM]
    out, total, found = list[Peak](), [np.log(SMOOTH) + _mixed([np.array(level[2]) for level in levels])], []
    alone = np.arange(frequency.size)
    for axes, belief in _hypotheses(tuple(sorted(set(data.axis.tolist())))):
        single = log_prior + np.log((1.0 - TWO) * belief) + _evidence(data, levels, axes, (frequency,))
        one, two = _pairs(data, levels, axes, frequency, log_prior, single)
        joint = _evidence(data, levels, axes, (frequency[one], frequency[two]))
        both = log_prior[one] + log_prior[two] + np.log(2.0 * TWO * belief) + joint
        total += [np.logaddexp.reduce(single), np.logaddexp.reduce(both)]
        found.append((axes, np.concatenate([alone, one, two]), np.concatenate([single, both, both])))
    for axes, at, each in found:
        weight = np.bincount(at, np.exp(each - np.logaddexp.reduce(total)), minlength=frequency.size)
        out += _peaks(axes, frequency, np.asarray(weight, dtype=np.float64), data.span_mm)
    return tuple(out)


def _hypotheses(axes: tuple[int, ...]) -> list[tuple[tuple[int, ...], float]]:
    """Groups of axes that may have the same periods, with their prior probabilities."""
    if len(axes) == 1:
        return [(axes, 1.0)]
    return [(axes, ALL_AXES), *(((a,), (1.0 - ALL_AXES) / len(axes)) for a in axes)]


def _mixed(values: list[F1]) -> F1:
    """Mean of evidences over the sizes of the scatter, as logarithms."""
    return np.asarray(np.logaddexp.reduce(np.array(values), axis=0) - np.log(len(values)))


def _evidence(data: Displacements, levels: list[tuple[F1, F2, float]], axes: tuple[int, ...], frequencies: tuple[F1, ...]) -> F1:
    """Log evidence of these periods at once, shape of one array of frequencies."""
    waves = np.concatenate([data.waves(axes, f) for f in frequencies], axis=-1)
    out = []
    for h, information, base in levels:
        asked = waves.transpose(0, 2, 1) @ h
        whole = waves.transpose(0, 2, 1) @ (information @ waves) + np.eye(waves.shape[-1])
        lower = np.linalg.cholesky(whole)
        half = np.linalg.solve(lower, asked[..., None])[..., 0]
        volume = np.log(np.diagonal(lower, axis1=1, axis2=2)).sum(axis=1)
        out.append(base + 0.5 * np.einsum("fi,fi->f", half, half) - volume)
    return _mixed(out)


def _pairs(
    data: Displacements, levels: list[tuple[F1, F2, float]], axes: tuple[int, ...], frequency: F1, log_prior: F1, single: F1
) -> Pair:
    """Pairs of frequencies near the best pairs of a coarse search; each pair once."""
    step = round(COARSE / FINE)
    coarse = np.arange(0, frequency.size, step)
    coarse = np.sort(coarse[np.argsort(-single[coarse])[:MOST]])
    waves = data.waves(axes, frequency[coarse])
    value = _mixed([base + gain_of_pairs(waves, h, information) for h, information, base in levels[::2]])
    one, two = np.nonzero(coarse[None, :] - coarse[:, None] >= APART * step)
    best = np.argsort(-(value[one, two] + log_prior[coarse[one]] + log_prior[coarse[two]]))[:LIKELY]
    shift = np.arange(-NEAR, NEAR + 1)
    near = np.broadcast_arrays(coarse[one[best]][:, None, None] + shift[:, None], coarse[two[best]][:, None, None] + shift)
    pairs = np.unique(np.clip(np.stack(near, axis=-1).reshape(-1, 2), 0, frequency.size - 1), axis=0)
    return pairs[:, 0], pairs[:, 1]


def gain_of_pairs(waves: NDArray[np.float64], h: F1, information: F2) -> F2:
    """Log evidence of every pair of frequencies minus the log evidence of no wave, shape (f, f), valid above the diagonal.

    ``waves`` (f, n, k): displacements by the k waves of each frequency. The waves are scaled so that each frequency alone has the unit
    matrix as posterior precision; the gain by a second frequency then needs only the k x k blocks across; they are computed one row of
    blocks at a time.
    """
    f, n, k = waves.shape
    back = np.linalg.inv(np.linalg.cholesky(waves.transpose(0, 2, 1) @ (information @ waves) + np.eye(k)))
    white = np.ascontiguousarray((waves @ back.transpose(0, 2, 1)).transpose(1, 2, 0))  # (n, k, f)
    asked, volume = np.einsum("n,nkf->kf", h, white), np.log(np.diagonal(back, axis1=1, axis2=2)).sum(axis=1)
    known = (information @ white.reshape(n, -1)).reshape(white.shape)
    out = np.zeros((f, f))
    for start in range(0, f, BLOCK):
        rows, columns = slice(start, start + BLOCK), slice(start, f)
        across = np.tensordot(white[..., rows], known[..., columns], (0, 0)).transpose(0, 2, 1, 3)  # (of one, of two, one, two)
        alone = 0.5 * (asked[:, rows] ** 2).sum(axis=0) + volume[rows]
        beside = _gain_beside(np.ascontiguousarray(across), asked[:, rows], asked[:, columns])
        out[rows, columns] = alone[:, None] + volume[columns] + beside
    return out


def _gain_beside(across: NDArray[np.float64], one: F2, two: F2) -> F2:
    """Log evidence that a second frequency adds to a first one, by elimination of one wave after the other, shape (first, second).

    ``across`` (k, k, first, second), ``one`` (k, first), ``two`` (k, second), of waves scaled as in `gain_of_pairs`.
    """
    k = len(across)
    left = [two[i] - sum(across[w, i] * one[w, :, None] for w in range(k)) for i in range(k)]
    whole = [[(i == j) - sum(across[w, i] * across[w, j] for w in range(k)) for j in range(i + 1)] for i in range(k)]
    out = np.zeros(across.shape[2:])
    for j in range(k):
        pivot = np.maximum(whole[j][j], 1e-12)
        out += 0.5 * left[j] ** 2 / pivot - 0.5 * np.log(pivot)
        for i in range(j + 1, k):
            ratio = whole[i][j] / pivot
            left[i] = left[i] - ratio * left[j]
            for m in range(j + 1, i + 1):
                whole[i][m] = whole[i][m] - ratio * whole[m][j]
    return out


def _peaks(axes: tuple[int, ...], frequency: F1, weight: F1, span_mm: float) -> list[Peak]:
    """Probable periods: frequencies with the probability around each of them, within the resolution of the positions."""
    out: list[Peak] = []
    while weight.max() > 0.1 * LEAST:
        near = np.abs(frequency - frequency[np.argmax(weight)]) <= 0.5 / span_mm
        mine = np.where(near, weight, 0.0)
        if mine.sum() >= LEAST:
            mean = float(np.average(frequency, weights=mine))
            spread = float(np.sqrt(np.average((frequency - mean) ** 2, weights=mine)))
            out.append(Peak(axes, mean, max(spread, FINE / span_mm / np.sqrt(12.0)), min(float(mine.sum()), 1.0)))
        weight = np.where(near, 0.0, weight)
    return out


def _prior(frequencies: F1, span_mm: float) -> F1:
    """Prior probability of every searched frequency: usual leads get `USUAL` (within the positions' resolution), all together the rest."""
    near = np.abs(frequencies[:, None] - 1.0 / np.array(LEADS_MM)) < 0.5 / span_mm
    usual = (near / np.maximum(near.sum(axis=0), 1)).sum(axis=1) / len(LEADS_MM)
    return np.asarray((1.0 - SMOOTH) * (USUAL * usual + (1.0 - USUAL) / frequencies.size))
