"""The null space of a campaign told to a metrologist: what, why, what it may do to a workpiece, and what would show it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from abbe.models.arrays import F1, F2
from abbe.models.geometry.bases import Term
from abbe.models.machine import Machine
from abbe.models.solvers.decomposition import singular_values, svd
from abbe.models.solvers.identifiability import RANK_TOLERANCE
from abbe.models.solvers.observability.additions import Addition
from abbe.models.solvers.observability.cures import CampaignLayout, CureTrial, best_sequence, trials
from abbe.models.solvers.observability.rank import SeenInformation
from abbe.models.solvers.observability.volume import frame_free_design, inner_box
from abbe.models.solvers.observability.words import Family, families, sentence
from abbe.models.solvers.observe import with_tool

HARMLESS = 1e-7
"""Deviation (unit columns, relative to the largest) below which a combination moves the tool nowhere."""
CURES = 3
TOOLS = ("tool", "aside")


@dataclass(frozen=True)
class HiddenGroup:
    """Combinations of some motions that leave no trace.

    Attributes
    ----------
    motions : tuple of str
    count : int
        How many independent combinations.
    weights : tuple of (name, value)
        The first combination at the size that a typical machine may have: coefficients in mm and rad.
    vectors : array, shape (p, count)
        All of them, coefficients' own units.
    harmless : bool
        Moves the tool nowhere in the volume with the tools used (but will with another).
    effect_mm : float
        Otherwise: what a typical machine may hide there, rms length at the worst point, rigid motion removed, mm.
    cause, cures, text
        Why; what would show all of it (one of these is enough); everything in one sentence or two.
    """

    motions: tuple[str, ...]
    count: int
    weights: tuple[tuple[str, float], ...]
    vectors: F2
    harmless: bool
    effect_mm: float
    cause: str
    cures: tuple[str, ...]
    text: str


@dataclass(frozen=True)
class Advice:
    """What to add next: ``rank`` after it, of ``of`` coefficients."""

    cure: str
    rank: int
    of: int

    @property
    def text(self) -> str:
        """In words."""
        return f"{self.cure[:1].upper()}{self.cure[1:]} would raise the rank to {self.rank} of {self.of}."


@dataclass(frozen=True)
class HiddenDirection:
    """Hidden groups, advice, and the rank no run with the same tools could exceed."""

    groups: tuple[HiddenGroup, ...]
    advice: tuple[Advice, ...]
    reachable: int


def picture(campaign: CampaignLayout, seen: SeenInformation, prior_sd: F1) -> HiddenDirection:
    """Everything about the null space; ``prior_sd``: typical size of every coefficient, shape (p,)."""
    terms = campaign.terms
    field = _fields(campaign, seen.factor)
    silent = _silent(seen.null_space, field)
    tried = trials(campaign, seen)
    harmful = families(terms, seen.null_space, seen.factor, found=silent)
    groups = [_group(terms, f, seen, tried, _effect(f, field, seen.factor, prior_sd), prior_sd) for f in harmful]
    other_tools = [t for t in tried if t.addition.key in TOOLS]  # what moves no tool in use is a matter of the tool alone
    groups += [_group(terms, f, seen, other_tools, 0.0, prior_sd) for f in families(terms, silent, seen.factor)]
    steps = best_sequence(tried, seen.null_space.shape[1])
    advice = tuple(Advice(a.cure, seen.rank + shown, len(terms)) for a, shown in steps)
    return HiddenDirection(tuple(groups), advice, _reachable(field))


def _fields(campaign: CampaignLayout, factor: F1) -> F2:
    """Deviation over the inner volume with every tool in use, rigid motion removed, unit columns, shape (rows, p)."""
    points = _lines(campaign.machine, max(t.order for t in campaign.terms) + 3)
    tools = {tuple(with_tool(campaign.machine, r.tool_mm).tool_mm): r.tool_mm for r in campaign.runs}
    machines = [with_tool(campaign.machine, tool) for tool in tools.values()]
    parts = [frame_free_design(m, campaign.terms, points, points).reshape(-1, len(campaign.terms)) for m in machines]
    return np.asarray(np.concatenate(parts) * factor)


def _lines(machine: Machine, nodes: int) -> F2:
    """Points on nine lines along each axis of the inner volume.

    They tell as much as a whole grid: an error motion depends on one axis, and its lever on the others linearly (rule G).
    """
    box = inner_box(machine)
    three = np.stack([box[:, 0], box.mean(axis=1), box[:, 1]], axis=1)
    out = []
    for a in range(3):
        along = [three[k] if k != a else np.linspace(box[a, 0], box[a, 1], nodes) for k in range(3)]
        out.append(np.stack(np.meshgrid(*along, indexing="ij"), axis=-1).reshape(-1, 3))
    return np.concatenate(out)


def _silent(null_space: F2, field: F2) -> F2:
    """Hidden combinations that move the tool nowhere in the volume, orthonormal in unit columns, shape (p, m)."""
    if not null_space.shape[1]:
        return null_space
    _, s, vt = svd(field @ null_space, full_matrices=True)
    s = np.concatenate([s, np.zeros(null_space.shape[1] - s.size)])
    top = float(np.linalg.norm(field, axis=0).max())
    return np.asarray(null_space @ vt[s <= HARMLESS * top].T)


def _reachable(field: F2) -> int:
    s = singular_values(field)
    return int((s > RANK_TOLERANCE * s[0]).sum())


def _effect(family: Family, field: F2, factor: F1, prior_sd: F1) -> float:
    """Largest rms deviation over the grid that typical sizes of these combinations make, mm."""
    root = _typical(family, prior_sd)
    moved = (field / factor) @ root
    return float(np.sqrt((moved**2).sum(axis=1).reshape(-1, 3).sum(axis=1).max()))


def _typical(family: Family, prior_sd: F1) -> F2:
    """Square root of what the priors leave for these combinations alone: columns of one standard deviation each, own units."""
    scaled = family.vectors / prior_sd[:, None]
    q, _ = linalg.qr(scaled, mode="economic", check_finite=False)
    return np.asarray(q * prior_sd[:, None])


def _group(
    terms: tuple[Term, ...], family: Family, seen: SeenInformation, tried: list[CureTrial], effect_mm: float, prior_sd: F1
) -> HiddenGroup:
    count = family.vectors.shape[1]
    coordinates = linalg.qr(seen.null_space.T @ (family.vectors / seen.factor[:, None]), mode="economic", check_finite=False)[0]
    shown = [(t.addition, t.shows(coordinates)) for t in tried]
    full = [a for a, n in shown if n == count]
    one = family.vectors[:, 0] / np.linalg.norm(family.vectors[:, 0] / prior_sd)
    weights = tuple((terms[i].name, float(one[i])) for i in np.argsort(-np.abs(one / prior_sd), kind="stable") if one[i])
    cause = full[0].cause if full else ""
    group = HiddenGroup(
        family.motions, count, weights, family.vectors, effect_mm == 0.0, effect_mm, cause, tuple(a.cure for a in full[:CURES]), ""
    )
    ending = full[0].ending if full else ""
    partly = max(shown, key=lambda item: item[1], default=None)
    return replace(group, text=" ".join((sentence(terms, family, ending) + ".", _effect_words(group), _cure_words(group, partly))))


def _effect_words(group: HiddenGroup) -> str:
    if group.harmless:
        return "With the tools in use it moves nothing, with another tool it does."
    return f"It may hide {group.effect_mm * 1e3:.2g} µm somewhere in the inner 80 % of the volume."


def _cure_words(group: HiddenGroup, partly: tuple[Addition, int] | None) -> str:
    if group.cures:
        return f"Why: {group.cause}. It would be seen with {' or '.join(group.cures)}."
    if partly is None or not partly[1]:
        return "None of the usual additions alone shows it; two of them together were not tried."
    return f"No single usual measurement shows all of it; {partly[0].cure} would show {partly[1]} of {group.count}."
