"""What would make hidden combinations visible: every usual addition to a campaign is tried out
(`abbe.models.solvers.observability.additions`).

Nothing is looked up: the rank with each addition is computed on the campaign at hand, so the advice fits this machine and these runs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from abbe.models.arrays import F2
from abbe.models.geometry.bases import Term
from abbe.models.machine import Machine
from abbe.models.solvers.decomposition import singular_values
from abbe.models.solvers.identifiability import project_out
from abbe.models.solvers.observability.additions import Addition, additions
from abbe.models.solvers.observability.free import Play, play
from abbe.models.solvers.observability.rank import (
    CampaignColumns,
    Knowledge,
    SeenInformation,
    campaign_columns,
    stated_knowledge,
    with_knowledge,
)
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe import SetupUnknowns, setup_unknowns
from abbe.models.solvers.priors import Priors

SHOWN = 1e-7
"""Trace (unit columns) from which a hidden combination counts as shown by an addition; hidden means below 1e-9."""


@dataclass(frozen=True)
class CampaignLayout:
    """What was, or is to be, measured: nominal machine, model terms, runs, their compressed columns, and what is known of the set-up."""

    machine: Machine
    terms: tuple[Term, ...]
    runs: tuple[RunData, ...]
    columns: CampaignColumns
    known: Knowledge


@dataclass(frozen=True)
class CureTrial:
    """An addition and what it would show: ``seen``, shape (rows, k), per unit of each hidden combination, set-up unknowns out."""

    addition: Addition
    seen: F2

    def shows(self, combinations: F2) -> int:
        """How many of some hidden combinations, columns (k, m) of orthonormal coordinates, it makes visible."""
        return count_seen(self.seen @ combinations)


def count_seen(seen: F2) -> int:
    """How many hidden combinations a design, shape (rows, k), shows; what was hidden shows less than 1e-9 there (unit columns)."""
    s = singular_values(seen) if seen.size else np.zeros(0)
    return int((s > SHOWN).sum())


def trials(campaign: CampaignLayout, seen: SeenInformation) -> list[CureTrial]:
    """Try every usual addition on what is hidden; none if nothing is hidden."""
    if not seen.null_space.shape[1]:
        return []
    order = max(t.order for t in campaign.terms)
    tried = additions(campaign.machine, campaign.runs, campaign.known, campaign.columns.setup_names, order)
    hidden = play(campaign.columns, campaign.known, seen)
    return [CureTrial(a, _shown(campaign, a, hidden)) for a in tried]


def best_sequence(found: list[CureTrial], hidden: int) -> list[tuple[Addition, int]]:
    """Additions in the order in which each shows most of what is still hidden, and how many combinations are visible after each."""
    out: list[tuple[Addition, int]] = []
    stack, left, shown = np.zeros((0, hidden)), list(found), 0
    while left and shown < hidden:
        counts = [count_seen(np.concatenate([stack, t.seen])) for t in left]
        best = int(np.argmax(counts))
        if counts[best] <= shown:
            break
        shown = counts[best]
        stack = np.concatenate([stack, left[best].seen])
        out.append((left.pop(best).addition, shown))
    return out


def _shown(campaign: CampaignLayout, addition: Addition, hidden: Play) -> F2:
    """What an addition shows per unit of each hidden combination (unit columns), shape (at most k, k); its own set-up unknowns out."""
    if not addition.runs:
        at = [i for i, group in enumerate(hidden.groups) if set(group) & set(addition.knows)]
        size = np.linalg.norm(campaign.columns.setup[:, [campaign.columns.setup_names.index(hidden.groups[i][0]) for i in at]], axis=0)
        return _upper(project_out(hidden.free[at] * size[:, None], hidden.loose[at] * size[:, None]))
    runs = (*campaign.runs, *addition.runs)
    setup = setup_unknowns(runs, Priors(), campaign.machine)
    new = campaign_columns(campaign.machine, campaign.terms, addition.runs, setup)
    known = _known_with(campaign, runs, setup, new)
    machine, free, groups = with_knowledge(new, known)
    old = [next((k for k, g in enumerate(hidden.groups) if set(g) & set(group)), -1) for group in groups]
    shared, fresh = [i for i, k in enumerate(old) if k >= 0], [i for i, k in enumerate(old) if k < 0]
    there = [old[i] for i in shared]
    response = machine @ hidden.machine + free[:, shared] @ hidden.free[there]
    size = np.linalg.norm(free[:, shared], axis=0) @ np.abs(hidden.loose[there])
    loose = free[:, shared] @ hidden.loose[there]
    loose = loose[:, np.linalg.norm(loose, axis=0) > SHOWN * size]
    return _upper(project_out(response, np.concatenate([loose, free[:, fresh]], axis=1)))


def _known_with(campaign: CampaignLayout, runs: tuple[RunData, ...], setup: SetupUnknowns, new: CampaignColumns) -> Knowledge:
    """Unknowns that the addition brings are known or free by the same rules as the old ones, which stay what they were."""
    known, before = campaign.known, set(campaign.columns.setup_names)
    stated = stated_knowledge(campaign.terms, runs, setup.names).held
    held = {n: v for n, v in stated.items() if n not in before} | {n: v for n, v in known.held.items() if n in new.setup_names}
    return replace(known, held=held)


def _upper(shown: F2) -> F2:
    return np.asarray(linalg.qr(shown, mode="r", check_finite=False)[0][: shown.shape[1]])
