"""Number of Legendre orders that the readings support, chosen by held-out runs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from abbe.models.arrays import F1, F2
from abbe.models.geometry.bases import Term
from abbe.models.solvers.components import Components
from abbe.models.solvers.information import I1, InformationSums, total
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.priors import SizeModel

FOLDS = 8
RIGID6 = 0
"""Level of the model with three scales and three squareness errors only."""


@dataclass(frozen=True)
class OrderChoice:
    """Score of every model on readings it had not seen.

    ``levels``: 0 for `RIGID6`, else the highest Legendre order. ``score``: mean log predictive density per fold, best = 0. ``se``: standard
    error of that difference over the folds. ``chosen``: the simplest level within one standard error of the best.
    """

    levels: tuple[int, ...]
    score: F1
    se: F1
    chosen: int


def folds(runs: tuple[RunData, ...]) -> I1:
    """Fold of each run: whole set-ups are held out, spread evenly over both instruments; shape (runs,)."""
    out = np.zeros(len(runs), dtype=np.int64)
    place: dict[str, int] = {}
    for kind in ("bar", "laser"):
        for run in runs:
            if run.kind == kind and run.setup not in place:
                place[run.setup] = len(place) % FOLDS
    for i, run in enumerate(runs):
        out[i] = place[run.setup]
    return out


def term_levels(terms: tuple[Term, ...], rest: int) -> I1:
    """Simplest level whose model holds each unknown, shape (p,); -1 for lost motion and set-up, which every model has."""
    own = [RIGID6 if t.order == 0 or (t.order == 1 and t.component == t.axis) else t.order for t in terms]
    return np.array(own + [-1] * rest, dtype=np.int64)


def truncated_evidence(sums: InformationSums, c: Components, model: SizeModel, level: I1) -> tuple[tuple[int, ...], F1]:
    """Log evidence of every truncation of the model; constants that all levels share are left out.

    A truncated model has no Legendre coefficients above its level; the others keep their prior covariance.
    """
    levels = tuple(int(v) for v in np.unique(level[level >= 0]))
    w = np.exp(-c.eta)
    root = model.root * c.half(model)
    gram, moment, fixed = _without_setup(np.tensordot(w, sums.gram, 1), w @ sums.moment, root, level)
    at = np.flatnonzero(level >= 0)
    covariance = root[at] @ root[at].T
    out = []
    for k in levels:
        keep = np.flatnonzero(level[at] <= k)
        low = linalg.cholesky(covariance[np.ix_(keep, keep)], lower=True, check_finite=False)
        inside = low.T @ gram[np.ix_(keep, keep)] @ low
        np.fill_diagonal(inside, inside.diagonal() + 1.0)
        factor = linalg.cholesky(inside, lower=True, check_finite=False)
        z = linalg.solve_triangular(factor, low.T @ moment[keep], lower=True, check_finite=False)
        out.append(fixed + 0.5 * float(z @ z) - float(np.log(factor.diagonal()).sum()))
    return levels, np.array(out)


def _without_setup(gram: F2, moment: F1, root: F2, level: I1) -> tuple[F2, F1, float]:
    """Normal equations of the smooth terms with lost motion and set-up integrated out, and the log evidence of that part."""
    terms, rest = np.flatnonzero(level >= 0), np.flatnonzero(level < 0)
    sd = root.diagonal()[rest]  # independent of each other
    own = gram[np.ix_(rest, rest)] * sd[:, None] * sd
    np.fill_diagonal(own, own.diagonal() + 1.0)
    factor = linalg.cholesky(own, lower=True, check_finite=False)
    both = np.column_stack([gram[np.ix_(rest, terms)], moment[rest]]) * sd[:, None]
    half = linalg.solve_triangular(factor, both, lower=True, check_finite=False)
    z = half[:, -1]
    fixed = 0.5 * float(z @ z) - float(np.log(factor.diagonal()).sum())
    return gram[np.ix_(terms, terms)] - half[:, :-1].T @ half[:, :-1], moment[terms] - half[:, :-1].T @ z, fixed


def choose(parts: tuple[InformationSums, ...], c: Components, model: SizeModel, level: I1) -> OrderChoice:
    """Score all levels on held-out folds (their set-up unknowns integrated out), or by evidence where fewer than 3 folds exist.

    log p(held-out | others) = log p(all) - log p(others). Sizes and noise are those of all readings; the unknowns themselves never see
    the fold they are scored on.
    """
    whole = total(parts)
    levels, everything = truncated_evidence(whole, c, model, level)
    used = [s for s in parts if s.count.sum() > 0]
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
