"""How many Legendre orders the readings carry: chosen by runs that were held out, not by hand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from models.arrays import F1, F2
from models.geometry.bases import Term
from models.solvers.components import Components
from models.solvers.information import I1, Sums, total
from models.solvers.observations import RunData
from models.solvers.priors import SizeModel

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


def truncated_evidence(sums: Sums, c: Components, model: SizeModel, level: I1) -> tuple[tuple[int, ...], F1]:
    """Log evidence of every truncation of the model; constants that all levels share are left out.

    A truncated model has no Legendre coefficients above its level; the others keep their prior covariance.
    """
    levels = tuple(int(v) for v in np.unique(level[level >= 0]))
    w = np.exp(-c.eta)
    gram, moment = np.einsum("k,kij->ij", w, sums.gram), w @ sums.moment
    scaled = model.root * c.half(model)
    out = []
    for k in levels:
        keep = np.flatnonzero(level <= k)
        low = linalg.cholesky(scaled[keep] @ scaled[keep].T, lower=True)
        inside = low.T @ gram[np.ix_(keep, keep)] @ low
        np.fill_diagonal(inside, inside.diagonal() + 1.0)
        factor = linalg.cholesky(inside, lower=True)
        z = linalg.solve_triangular(factor, low.T @ moment[keep], lower=True)
        out.append(0.5 * float(z @ z) - float(np.log(factor.diagonal()).sum()))
    return levels, np.array(out)


def choose(parts: tuple[Sums, ...], c: Components, model: SizeModel, level: I1) -> OrderChoice:
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
