"""Free unknowns of a campaign (set-up and lost motion) that nothing tells: alone, or together with the machine's own errors.

A bar length that nobody calibrated grows with the machine's three scales and no reading changes. Then the length is as hidden as the scales
are, however small its uncertainty looks: the priors alone hold it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F2
from abbe.models.solvers.decomposition import svd
from abbe.models.solvers.designs import unit_columns
from abbe.models.solvers.identifiability import HIDDEN, RANK_TOLERANCE
from abbe.models.solvers.observability.rank import CampaignColumns, Knowledge, SeenInformation, with_knowledge

NOTHING = 1e-7
"""Entries of unit vectors below this are rounding."""


@dataclass(frozen=True)
class Play:
    """What leaves no trace in the campaign: hidden combinations together with the changes of free unknowns that cancel them.

    Attributes
    ----------
    groups : tuple of tuples of names
        Names behind each free unknown.
    machine, free : arrays, shape (p, k) and (q, k)
        Coefficients of each hidden combination and the free unknowns that go with it, own units.
    loose : array, shape (q, m)
        Changes of free unknowns alone that leave no trace, own units.
    size : array, shape (q, 1)
        Value of each free unknown that is one in unit columns.
    """

    groups: tuple[tuple[str, ...], ...]
    machine: F2
    free: F2
    loose: F2
    size: F2


def play(columns: CampaignColumns, known: Knowledge, seen: SeenInformation) -> Play:
    """Null space of machine and free unknowns together, from that of the machine alone (`what_is_seen`)."""
    machine, free, groups = with_knowledge(columns, known)
    unit, factor = unit_columns(free)
    u, s, vt = svd(unit, full_matrices=True)
    rank = int((s > RANK_TOLERANCE * s[0]).sum()) if s.size else 0
    hidden = seen.null_space * seen.factor[:, None]
    answer = vt[:rank].T @ ((u[:, :rank].T @ (machine @ hidden)) / s[:rank, None])
    loose = np.where(np.abs(vt[rank:].T) > NOTHING, vt[rank:].T, 0.0)  # rounding must not count as an unknown of its own
    return Play(groups, hidden, -answer * factor[:, None], loose * factor[:, None], factor[:, None])


def hidden_free(columns: CampaignColumns, known: Knowledge, seen: SeenInformation) -> frozenset[str]:
    """Free unknowns that take part in what is hidden, by name.

    Among them lost motion of axes that never reverse, like the pole axis of one helix. What is known (`Knowledge.held`) is not free.
    """
    found = play(columns, known, seen)
    share = np.linalg.norm(np.concatenate([found.free, found.loose], axis=1) / found.size, axis=1)
    return frozenset(n for group, s in zip(found.groups, share, strict=True) if s > HIDDEN for n in group)
