"""Knowledge of every single parameter and error motion, and which motions may be written into a table of their own.

A parameter in a hidden combination has no value of its own, however small its uncertainty: only the prior determines it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.geometry.bases import Term, term_values
from abbe.models.machine import Machine
from abbe.models.solvers.designs import unit_columns
from abbe.models.solvers.identifiability import HIDDEN, RANK_TOLERANCE, taking_part
from abbe.models.solvers.least_squares import svd
from abbe.models.solvers.observability.rank import CampaignColumns, Knowledge, ObservedInformation, with_knowledge

NOTHING = 1e-7
"""Entries of unit vectors below this are rounding."""


@dataclass(frozen=True)
class Play:
    """Hidden combinations of the campaign, together with the changes of free unknowns that cancel them.

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


def play(columns: CampaignColumns, known: Knowledge, seen: ObservedInformation) -> Play:
    """Null space of machine and free unknowns together, from that of the machine alone (`observed_information`)."""
    machine, free, groups = with_knowledge(columns, known)
    unit, factor = unit_columns(free)
    u, s, vt = svd(unit, full_matrices=True)
    rank = int((s > RANK_TOLERANCE * s[0]).sum()) if s.size else 0
    hidden = seen.null_space * seen.factor[:, None]
    answer = vt[:rank].T @ ((u[:, :rank].T @ (machine @ hidden)) / s[:rank, None])
    loose = np.where(np.abs(vt[rank:].T) > NOTHING, vt[rank:].T, 0.0)  # rounding must not count as an unknown of its own
    return Play(groups, hidden, -answer * factor[:, None], loose * factor[:, None], factor[:, None])


def hidden_free(columns: CampaignColumns, known: Knowledge, seen: ObservedInformation) -> frozenset[str]:
    """Free unknowns that take part in what is hidden, by name.

    Among them lost motion of axes that never reverse, like the pole axis of one helix. What is known (`Knowledge.held`) is not free.
    """
    found = play(columns, known, seen)
    share = np.linalg.norm(np.concatenate([found.free, found.loose], axis=1) / found.size, axis=1)
    return frozenset(n for group, s in zip(found.groups, share, strict=True) if s > HIDDEN for n in group)


Status = Literal["observed", "weak", "not observable"]
OBSERVED, SEEN = 0.9, 0.1
"""Share of information from data: from 0.9 on (u at most 0.32 of the prior's) a parameter is observed, below 0.1 (u at least 0.95 of it)
not observable; weak between."""
CORRELATED = 0.9
NODES = 41


@dataclass(frozen=True, slots=True)
class ParameterStatus:
    """One unknown: estimate (None before solving), standard uncertainty, prior standard deviation, in mm, rad or mm/s.

    ``share``: 1 - (u / prior)^2, how much of the information comes from the readings; ``status``: by `OBSERVED` and `SEEN`, and never
    better than ``"not observable"`` for a parameter that takes part in a hidden combination.
    """

    name: str
    value: float | None
    u: float
    prior: float
    share: float
    status: Status


@dataclass(frozen=True, slots=True)
class Correlation:
    """Two unknowns whose errors go together: ``r`` above 0.9 in magnitude."""

    first: str
    second: str
    r: float


@dataclass(frozen=True, slots=True)
class MotionStatus:
    """One error motion as a function over its stroke, or one squareness.

    ``share``: as of a parameter, for the function's mean variance over the stroke; ``hidden``: its coefficients that take part in hidden
    combinations; ``status`` as of a parameter; ``reason``: why it may not be written into a table, empty if it may.
    """

    name: str
    share: float
    u: float
    hidden: tuple[str, ...]
    status: Status
    reason: str


def status_of(share: float, *, hidden: bool) -> Status:
    """Word for a share of information from the readings."""
    if hidden or share < SEEN:
        return "not observable"
    return "observed" if share >= OBSERVED else "weak"


def parameters(
    names: tuple[str, ...], theta: F1 | None, covariance: F2, prior_sd: F1, hidden: frozenset[str]
) -> tuple[ParameterStatus, ...]:
    """Every unknown in the order of ``names``; ``hidden``: names of those that take part in hidden combinations."""
    u = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    share = np.clip(1.0 - (u / prior_sd) ** 2, 0.0, 1.0)
    return tuple(
        ParameterStatus(
            name, None if theta is None else float(theta[i]), float(u[i]), float(prior_sd[i]), float(share[i]),
            status_of(float(share[i]), hidden=name in hidden),
        )
        for i, name in enumerate(names)
    )  # fmt: skip


def correlations(names: tuple[str, ...], covariance: F2) -> tuple[Correlation, ...]:
    """Pairs of unknowns with a correlation above 0.9 in magnitude, strongest first."""
    u = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    r = np.triu(covariance / np.outer(u, u), 1)
    first, second = np.nonzero(np.abs(r) > CORRELATED)
    found = [Correlation(names[i], names[j], float(r[i, j])) for i, j in zip(first, second, strict=True)]
    return tuple(sorted(found, key=lambda c: -abs(c.r)))


def hidden_terms(terms: tuple[Term, ...], null_space: F2) -> frozenset[str]:
    """Coefficients that take part in a hidden combination; ``null_space``: orthonormal in unit columns, shape (p, k)."""
    return taking_part(tuple(t.name for t in terms), null_space)


def motions(machine: Machine, terms: tuple[Term, ...], covariance: F2, prior: F2, hidden: frozenset[str]) -> tuple[MotionStatus, ...]:
    """Every error motion and squareness of the model, judged as a function over its stroke.

    Parameters
    ----------
    covariance, prior : array, shape (p, p)
        Of the terms' coefficients, after and before the runs.
    hidden : names of the coefficients that take part in hidden combinations.
    """
    nodes = np.stack([np.linspace(lo, hi, NODES) for lo, hi in machine.stroke_mm], axis=1)
    values = term_values(terms, nodes, machine.stroke_mm)
    out = []
    for name in dict.fromkeys(t.motion for t in terms):
        at = [i for i, t in enumerate(terms) if t.motion == name]
        basis = values[:, at] if terms[at[0]].order else np.ones((1, 1))
        after, before = (float(np.mean(np.einsum("ni,ij,nj->n", basis, c[np.ix_(at, at)], basis))) for c in (covariance, prior))
        mine = tuple(terms[i].name for i in at if terms[i].name in hidden)
        share = float(np.clip(1.0 - after / before, 0.0, 1.0)) if before > 0 else 0.0
        status = status_of(share, hidden=bool(mine))
        out.append(MotionStatus(name, share, float(np.sqrt(max(after, 0.0))), mine, status, _reason(mine, share, status)))
    return tuple(out)


def _reason(hidden: tuple[str, ...], share: float, status: Status) -> str:
    if hidden:
        return f"{', '.join(hidden)} cannot be told apart from other errors by these readings"
    if status == "observed":
        return ""
    return f"only {100.0 * share:.0f} % of what is known of it comes from the readings, the rest is an assumption"


def observable_motions(found: tuple[MotionStatus, ...], *, weak: bool = False) -> tuple[str, ...]:
    """Error motions that may be written into tables of their own: numbers that rest on readings.

    Rule: none of its coefficients is in a hidden combination, and the readings carry at least 90 % of its information (with ``weak``:
    10 %). A hidden combination then changes neither readings nor tables. Other motions may still be corrected where only their sum counts:
    in a grid of the volume for the tool that was measured with.
    """
    return tuple(m.name for m in found if m.status == "observed" or (weak and m.status == "weak"))
