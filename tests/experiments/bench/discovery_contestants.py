"""Naming what a simulation misses: `discover` against selections from general libraries over the very same columns.

(a) Forward selection by plain BIC: statsmodels' OLS fits every candidate beside those already chosen, the lowest BIC goes in, until none
falls. (b) Lasso: scikit-learn's LARS path over all columns at once, its point by BIC. Both get what took most of the work here: columns
of every effect at every key and start, and of structures without a name, whitened, with all that the present simulation may still
change taken out. A group of columns is an effect at one start of its non-linear parameters; starts of one label count as one name.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.discovery.baseline import baseline_of
from abbe.models.discovery.candidate_bank import UNNAMED, VISIBLE_SHARE, taken
from abbe.models.discovery.case import Case
from abbe.models.discovery.discover import discover
from abbe.models.discovery.selection import Contest
from abbe.models.discovery.whitened_problem import whiten
from abbe.models.effects.catalogue import CATALOGUE
from abbe.service.discovery.discovery_answer import answer_doc
from abbe.service.discovery.finding import finding_of

MOST_GROUPS = 10
"""Forward selection stops here at the latest: twice as many as `discover` may name. Plain BIC would go on and only add wrong names."""
LONGEST_PATH = 500


@dataclass(frozen=True)
class Candidates:
    """What all contestants choose from.

    Attributes
    ----------
    y : array, shape (n,): what the present simulation leaves of the readings, whitened.
    columns : array, shape (n, K): what it leaves of the candidates, each of length 1 (mm beside rad would upset the fits).
    labels : one per group; more than one group may have the same. groups : each group's columns.
    """

    y: F1
    columns: F2
    labels: tuple[str, ...]
    groups: tuple[slice, ...]


def candidates_of(case: Case, *, unnamed: bool = True) -> Candidates:
    """Columns by the product's own functions, so that they are the same; those of which the simulation leaves nothing are dropped.

    ``unnamed``: also structures without a name, placed where the gap stands out. Without them nobody can say "unknown".
    """
    problem = whiten(case, baseline_of(case))
    contest = Contest.of(problem, CATALOGUE)
    if unnamed:
        contest.look_for_more((), taken(problem, ()))
    labels: list[str] = []
    sizes: list[int] = []
    parts = []
    while contest.banks:  # one after the other is let go: memory is compared too
        bank = contest.banks.pop(0)
        left = np.concatenate([problem.projection.left(part.T.astype(np.float64)) for part in bank.parts], axis=1)
        length = np.linalg.norm(left, axis=0)
        seen = length**2 > VISIBLE_SHARE * bank.own
        for pick, first, size in zip(bank.picks, bank.first, bank.size, strict=True):
            labels.append(pick.label)
            sizes.append(int(seen[first : first + size].sum()))
        parts.append(left[:, seen] / length[seen])
        del bank, left
    y = np.array(problem.projection.residual)
    del problem, contest
    return grouped(y, np.concatenate(parts, axis=1), labels, sizes)


def grouped(y: F1, columns: F2, labels: Sequence[str], sizes: Sequence[int]) -> Candidates:
    """Columns group after group; groups of which no column is left are none."""
    ends = np.cumsum(sizes)
    kept = [(label, slice(int(end) - size, int(end))) for label, size, end in zip(labels, sizes, ends, strict=True) if size]
    return Candidates(y, columns, tuple(label for label, _ in kept), tuple(group for _, group in kept))


def bic_forward(c: Candidates) -> list[int]:
    """(a) Groups in the order in which they go in."""
    chosen: list[int] = []
    lowest = bic(c, chosen)
    while len(chosen) < MOST_GROUPS:
        tried = {g: bic(c, [*chosen, g]) for g in range(len(c.groups)) if g not in chosen}
        best = min(tried, key=lambda g: tried[g], default=None)
        if best is None or tried[best] >= lowest:
            break
        chosen.append(best)
        lowest = tried[best]
    return chosen


def bic(c: Candidates, chosen: Sequence[int]) -> float:
    """BIC of ordinary least squares over some groups, as statsmodels has it; by hand where there is nothing to fit."""
    n = c.y.size
    if not chosen:
        return n * float(np.log(2.0 * np.pi * (c.y @ c.y) / n) + 1.0)
    from statsmodels.regression.linear_model import OLS

    return float(OLS(c.y, np.concatenate([c.columns[:, c.groups[g]] for g in chosen], axis=1)).fit().bic)


def forward_evidence(c: Candidates, chosen: Sequence[int]) -> dict[str, float]:
    """For each label: by how much BIC rises without all its groups, halved as a logarithm of odds."""
    lowest = bic(c, chosen) if chosen else 0.0
    return {name: 0.5 * (bic(c, [g for g in chosen if c.labels[g] != name]) - lowest) for name in {c.labels[g] for g in chosen}}


def lasso_evidence(c: Candidates) -> dict[str, float]:
    """(b) For each label of the path's best point: half the chi-square of what its columns carry, where that pays for one parameter."""
    from sklearn.linear_model import LassoLarsIC

    weights = LassoLarsIC(criterion="bic", fit_intercept=False, max_iter=LONGEST_PATH).fit(c.columns, c.y).coef_
    out = {}
    for name in dict.fromkeys(c.labels):
        groups = [g for g, label in enumerate(c.labels) if label == name]
        chi2 = float(np.sum(sum(c.columns[:, c.groups[g]] @ weights[c.groups[g]] for g in groups) ** 2))
        if chi2 > np.log(c.y.size):
            out[name] = 0.5 * chi2
    return out


def answer(evidence: dict[str, float]) -> dict:
    """Names and verdict as `discover` gives them: "unknown", without names, where more than half of the evidence has no name."""
    named = {k: v for k, v in evidence.items() if not k.startswith(UNNAMED)}
    known, unknown = sum(named.values()), sum(v for k, v in evidence.items() if k not in named)
    verdict = "none" if not evidence else "unknown" if unknown > known else "named"
    told = sorted(named, key=lambda k: -named[k]) if verdict == "named" else []
    return {"verdict": verdict, "effects": [{"name": k, "evidence": named[k]} for k in told]}


def ours(case: Case) -> dict:
    """The product, as `abbe discover` calls it."""
    return answer_doc(finding_of(discover(case, CATALOGUE), case, CATALOGUE, {r.path.label: np.zeros(r.path.n) for r in case.runs}))


def forward(c: Candidates) -> dict:
    """(a)"""
    return answer(forward_evidence(c, bic_forward(c)))


def lasso(c: Candidates) -> dict:
    """(b)"""
    return answer(lasso_evidence(c))


PEERS: dict[str, tuple[Callable[[Candidates], dict], bool]] = {
    "bic-forward": (forward, True),
    "lasso": (lasso, True),
    "bic-forward-names": (forward, False),
    "lasso-names": (lasso, False),
}
"""How a peer chooses, and whether structures without a name are among its columns."""
CONTESTANTS = ("discover", *PEERS)
