"""Order of the model: the number of Legendre orders, or rigid6, chosen by its prediction of readings left out of the fit.

Whole set-ups are left out in turn; for the choice between rigid6 and 21 error motions also regions of the volume (a corner, the end of a
stroke), because left-out set-ups mostly lie where the others measured and hardly show how a model predicts elsewhere. Each score subtracts
a part of the readings from the normal equations; nothing is solved from the start.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2
from abbe.models.geometry.bases import SMOOTH_ORDER, Term
from abbe.models.solvers.components import I1, KINDS, Components, InformationSums
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.priors import SizeModel

FOLDS = 8
RIGID6 = 0
"""Level of the model with three scales and three squareness errors only."""
END, CORNER = 0.15, 0.3
"""`END`: part of a measured range that is taken as the end of the stroke. `CORNER`: part of each of the three ranges that makes a
corner."""
FEWEST = 6
"""Least number of readings of a region."""


def regions(runs: tuple[RunData, ...]) -> tuple[NDArray[np.intp], ...]:
    """Readings at each end of a measured range and in each corner of the measured box: row numbers over all runs.

    The same rows are listed once; regions that hold more than half of the readings are left out.
    """
    at = np.concatenate([r.axes_mm for r in runs])
    low, high = at.min(axis=0), at.max(axis=0)
    away = (at - low) / np.maximum(high - low, 1e-9)
    ways = [away, 1.0 - away]
    masks = [ways[end][:, axis] <= END for axis in np.flatnonzero(high > low) for end in (0, 1)]
    masks += [np.all([ways[end][:, axis] <= CORNER for axis, end in enumerate(ends)], axis=0) for ends in product((0, 1), repeat=3)]
    rows = {tuple(np.flatnonzero(m)) for m in masks}
    return tuple(np.array(r) for r in sorted(rows) if FEWEST <= len(r) <= len(at) / 2)


@dataclass(frozen=True)
class OrderChoice:
    """Score of every model on left-out readings.

    ``levels``: 0 for `RIGID6`, else the highest Legendre order. ``score``: mean log predictive density per fold, minus the mean of the best
    level. ``se``: standard error of this difference over the folds. ``chosen``: the simplest level within one standard error of the best.
    """

    levels: tuple[int, ...]
    score: F1
    se: F1
    chosen: int


def folds(runs: tuple[RunData, ...]) -> I1:
    """Fold of each run, shape (runs,): all runs of a set-up share a fold, and each instrument is spread evenly over the folds."""
    out = np.zeros(len(runs), dtype=np.int64)
    place: dict[str, int] = {}
    for kind in KINDS:
        for run in runs:
            if run.kind == kind and run.setup not in place:
                place[run.setup] = len(place) % FOLDS
    for i, run in enumerate(runs):
        out[i] = place[run.setup]
    return out


def term_levels(terms: tuple[Term, ...], rest: int) -> I1:
    """Lowest level whose model contains each unknown, shape (p,); -1 for lost motion and set-up, which every model has."""
    own = [
        RIGID6 if t.order == 0 or (t.order == 1 and t.component == t.axis) else t.order if t.order <= SMOOTH_ORDER else -1 for t in terms
    ]
    return np.array(own + [-1] * rest, dtype=np.int64)


def truncated_evidence(sums: InformationSums, c: Components, model: SizeModel, level: I1) -> tuple[tuple[int, ...], F1]:
    """Levels, and the log evidence of the model truncated at each; constants that all levels share are left out.

    A truncated model has no Legendre coefficients above its level; the others keep their prior covariance.
    """
    levels = tuple(int(v) for v in np.unique(level[level >= 0]))
    w = np.exp(-c.eta)
    root = model.root * c.half(model)
    gram, rhs, fixed = _without_setup(np.tensordot(w, sums.gram, 1), w @ sums.rhs, root, level)
    at = np.flatnonzero(level >= 0)
    covariance = root[at] @ root[at].T
    out = []
    for k in levels:
        keep = np.flatnonzero(level[at] <= k)
        low = scipy.linalg.cholesky(covariance[np.ix_(keep, keep)], lower=True, check_finite=False)
        inside = low.T @ gram[np.ix_(keep, keep)] @ low
        np.fill_diagonal(inside, inside.diagonal() + 1.0)
        factor = scipy.linalg.cholesky(inside, lower=True, check_finite=False)
        z = scipy.linalg.solve_triangular(factor, low.T @ rhs[keep], lower=True, check_finite=False)
        out.append(fixed + 0.5 * float(z @ z) - float(np.log(factor.diagonal()).sum()))
    return levels, np.array(out)


def _without_setup(gram: F2, rhs: F1, root: F2, level: I1) -> tuple[F2, F1, float]:
    """Normal equations of the smooth terms with lost motion and set-up integrated out, and the log evidence of that part."""
    terms, rest = np.flatnonzero(level >= 0), np.flatnonzero(level < 0)
    own = root[np.ix_(rest, rest)]
    turn = own.T @ gram[rest]
    inside = turn[:, rest] @ own
    np.fill_diagonal(inside, inside.diagonal() + 1.0)
    factor = scipy.linalg.cholesky(inside, lower=True, check_finite=False)
    both = np.column_stack([turn[:, terms], own.T @ rhs[rest]])
    half = scipy.linalg.solve_triangular(factor, both, lower=True, check_finite=False)
    z = half[:, -1]
    fixed = 0.5 * float(z @ z) - float(np.log(factor.diagonal()).sum())
    return gram[np.ix_(terms, terms)] - half[:, :-1].T @ half[:, :-1], rhs[terms] - half[:, :-1].T @ z, fixed


def choose(whole: InformationSums, left_out: tuple[InformationSums, ...], c: Components, model: SizeModel, level: I1) -> OrderChoice:
    """Score all levels on every part of the readings that is left out in turn; with fewer than 3 parts, by evidence.

    log p(left out | others) = log p(all) - log p(others); set-up unknowns are integrated out. Sizes and noise come from all readings; the
    unknowns themselves are estimated without the part on which they are scored.
    """
    levels, everything = truncated_evidence(whole, c, model, level)
    used = [s for s in left_out if s.count.sum() > 0]
    if len(used) < 3:
        score = everything[None] - everything.max()
    else:
        score = everything - np.array([truncated_evidence(whole.minus(s), c, model, level)[1] for s in used])
    mean: F1 = score.mean(axis=0)
    best = int(np.argmax(mean))
    difference: F2 = score - score[:, best : best + 1]
    se = difference.std(axis=0, ddof=1) / np.sqrt(len(score)) if len(score) > 1 else np.zeros(len(levels))
    good = [i for i in range(len(levels)) if mean[best] - mean[i] <= se[i]]
    return OrderChoice(levels, mean - mean[best], np.asarray(se), levels[good[0]])
