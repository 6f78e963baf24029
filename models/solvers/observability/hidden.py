"""Hidden combinations of a campaign (its null space) in a metrologist's terms: motions, causes, effect in the volume, and cures."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import scipy

from abbe.models.arrays import F1, F2
from abbe.models.geometry.bases import Term
from abbe.models.machine import AXES, Machine, with_tool
from abbe.models.solvers.least_squares import RANK_TOLERANCE, singular_values, sparse_rows, svd
from abbe.models.solvers.observability.cures import Addition, CampaignLayout, CureTrial, best_sequence, trials
from abbe.models.solvers.observability.rank import ObservedInformation
from abbe.models.solvers.observability.volume import frame_free_design, inner_box

LARGEST_SET, LARGEST_SET_OF_LOW, LOW = 3, 4, 2
"""Size of the largest sets of motions that are searched for hidden combinations: with all orders, and with orders up to `LOW`, which are
tried first (the slope of an angle times the travel of its own axis is of order 2). All other hidden combinations are reported as mixtures.
"""
INSIDE = 1e-9
"""A set of motions contains a hidden combination if its block of the null space's projector has an eigenvalue within this of 1."""
ENTRY = 1e-6
"""Entries of a unit vector below this are rounding."""
NEW = 1e-4
"""A unit vector is independent of the reported combinations if its component outside them is longer than this."""
LISTED = 6
_TURNS = {"AX": "roll", "BX": "pitch", "CX": "yaw", "AY": "pitch", "BY": "roll", "CY": "yaw", "CZ": "roll"}
_PAIRS = {"C0Y": "X and Y", "B0Z": "X and Z", "A0Z": "Y and Z"}


@dataclass(frozen=True)
class Family:
    """Hidden combinations of the same motions.

    ``motions``: ISO names, in the order of the terms; ``vectors``: shape (p, count), one combination per column, coefficients in their own
    units; ``exact``: found as a set of few motions, not a mixture.
    """

    motions: tuple[str, ...]
    vectors: F2
    exact: bool


def motion_text(motion: str) -> str:
    """An error motion in words with its ISO name: ``EAX`` is "the roll of X (EAX)"."""
    if motion in _PAIRS:
        return f"the squareness of {_PAIRS[motion]} ({motion})"
    what, axis = motion[1], motion[2]
    if what == axis:
        return f"the positioning of {axis} ({motion})"
    if what in AXES:
        return f"the straightness of {axis} in {what} ({motion})"
    turn = _TURNS.get(what + axis)
    return f"the {turn} of {axis} ({motion})" if turn else f"the tilt of {axis} about {AXES['ABC'.index(what)]} ({motion})"


def part_text(motion: str, orders: Iterable[int]) -> str:
    """Text for a part of a motion: its slope (order 1; for positioning the scale), its shape (order 2 and more), or the whole motion."""
    found, whole = sorted(set(orders)), motion_text(motion)
    if found == [0] or not found:
        return whole
    if found == [1]:
        return whole.replace("the positioning", "the scale") if motion[1] == motion[2] else f"the slope of {whole}"
    if found[0] == 1:
        return whole
    span = f"order {found[0]}" if found[0] == found[-1] else f"orders {found[0]} to {found[-1]}"
    return f"the shape ({span}) of {whole}"


def sentence(terms: tuple[Term, ...], family: Family, ending: str = "") -> str:
    """Sentence about the motions that cannot be distinguished, with their ratio if this is one number."""
    parts = [part_text(m, _orders(terms, family, m)) for m in family.motions]
    if len(parts) == 1:
        return f"{_upper(parts[0])} leaves no trace{ending}"
    if not family.exact and len(parts) > LISTED:
        count = family.vectors.shape[1]
        return f"{count} mixture{'s' if count > 1 else ''} of {len(parts)} motions ({', '.join(family.motions)}) leave no trace{ending}"
    return f"{_upper(', '.join(parts[:-1]))} and {parts[-1]} cannot be distinguished{ending}{_proportion(terms, family)}"


def _orders(terms: tuple[Term, ...], family: Family, motion: str) -> list[int]:
    return [t.order for t, row in zip(terms, family.vectors, strict=True) if t.motion == motion and row.any()]


def _proportion(terms: tuple[Term, ...], family: Family) -> str:
    """Text with the ratio of the two terms, if the family is one combination of two terms up to order 1; else empty."""
    used = np.flatnonzero(family.vectors[:, 0])
    if family.vectors.shape[1] != 1 or len(used) != 2 or any(terms[i].order > 1 for i in used):
        return ""
    reported = [(float(family.vectors[i, 0]), *_unit(terms[i])) for i in used]
    a, b = (value * size for value, size, _, _ in reported)
    one, other = (f"{unit} of {terms[i].motion}{end}" for i, (_, _, unit, end) in zip(used, reported, strict=True))
    return f": 10 {one} look like {-b / a * 10.0:.3g} {other}"


def _unit(term: Term) -> tuple[float, str, str]:
    """Display of a coefficient: factor, unit and reference; order 1 is shown as the change over the stroke."""
    size, unit = (1e3, "µm") if term.order > 0 and term.component < 3 else (1e6, "µrad")
    return (2.0 * size, unit, " over the stroke") if term.order else (size, unit, "")


def _upper(text: str) -> str:
    return text[:1].upper() + text[1:]


def families(terms: tuple[Term, ...], null: F2, factor: F1, *, found: F2 | None = None) -> list[Family]:
    """Split a null space into combinations of as few motions as possible.

    Parameters
    ----------
    terms : tuple of Term
    null : array, shape (p, k)
        Orthonormal basis of the null space, unit columns.
    factor : array, shape (p,)
        Coefficient in its own unit = factor times its value in unit columns.
    found : array, shape (p, m), optional
        Orthonormal combinations already reported; only combinations independent of them are returned.

    Returns
    -------
    list of Family, exact families first; all their vectors together with ``found`` span ``null``.
    """
    reported = np.zeros((len(terms), 0)) if found is None else found
    shadow = null @ null.T
    out: list[tuple[tuple[str, ...], F2]] = []
    for highest, largest in ((LOW, LARGEST_SET_OF_LOW), (max(t.order for t in terms), LARGEST_SET)):
        rows: dict[str, list[int]] = {}
        for i, t in enumerate(terms):
            if t.order <= highest:
                rows.setdefault(t.motion, []).append(i)
        new, reported = _of_few(shadow, rows, largest, reported, null.shape[1])
        out += new
    left, _ = _independent(_unit_length(sparse_rows(null.T).T), reported)
    return _merged(terms, out, factor) + ([_family(terms, left, factor, exact=False)] if left.shape[1] else [])


def _of_few(shadow: F2, rows: dict[str, list[int]], largest: int, reported: F2, count: int) -> tuple[list[tuple[tuple[str, ...], F2]], F2]:
    """New hidden combinations of sets of up to ``largest`` motions, smallest sets first; and the basis of all reported so far."""
    active = {m: at for m, at in rows.items() if np.trace(shadow[np.ix_(at, at)]) > INSIDE}
    out: list[tuple[tuple[str, ...], F2]] = []
    for size in range(1, largest + 1):
        for chosen, count_inside in _holding(shadow, active, size):
            known = sum(v.shape[1] for motions, v in out if set(motions) <= set(chosen))
            if reported.shape[1] == count or count_inside <= known:
                continue
            at = [i for m in chosen for i in active[m]]
            own = _inside(shadow, at)
            if np.linalg.norm(_beside(own, reported)) <= NEW:
                continue
            new, reported = _independent(_sparse(own, at), reported)
            if new.shape[1]:
                out.append((chosen, new))
    return out, reported


def _merged(terms: tuple[Term, ...], found: list[tuple[tuple[str, ...], F2]], factor: F1) -> list[Family]:
    """One family per set of motions, with the combinations of their slopes and of their shapes together."""
    by_motions: dict[tuple[str, ...], list[F2]] = {}
    for motions, vectors in found:
        by_motions.setdefault(motions, []).append(vectors)
    ranked = sorted(by_motions.items(), key=lambda item: len(item[0]))
    return [_family(terms, np.concatenate(v, axis=1), factor, exact=True) for _, v in ranked]


def _holding(shadow: F2, rows: dict[str, list[int]], size: int) -> list[tuple[tuple[str, ...], int]]:
    """Sets of ``size`` motions, with the number of hidden combinations that each contains: eigenvalues 1 of its block of the projector."""
    sets = list(combinations(rows, size))
    if not sets:
        return []
    indices = [[i for m in chosen for i in rows[m]] for chosen in sets]
    width = max(len(i) for i in indices)
    at = np.array([i + [-1] * (width - len(i)) for i in indices])  # -1: the padded row and column of zeros
    padded = np.pad(shadow, (0, 1))
    blocks = padded[at[:, :, None], at[:, None, :]]
    count = (np.linalg.eigvalsh(blocks) > 1.0 - INSIDE).sum(axis=1)
    return [(sets[i], int(count[i])) for i in np.flatnonzero(count)]


def _inside(shadow: F2, at: list[int]) -> F2:
    """Hidden combinations of these terms alone, orthonormal, shape (p, count)."""
    values, vectors = np.linalg.eigh(shadow[np.ix_(at, at)])
    own = vectors[:, values > 1.0 - INSIDE]
    out = np.zeros((shadow.shape[0], own.shape[1]))
    out[at] = own
    return out


def _sparse(own: F2, at: list[int]) -> F2:
    """A sparse basis of the same space, vectors of unit length."""
    out = np.zeros_like(own)
    out[at] = sparse_rows(own[at].T).T
    return _unit_length(out)


def _unit_length(vectors: F2) -> F2:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=0))


def _independent(vectors: F2, reported: F2) -> tuple[F2, F2]:
    """Return the vectors that are independent of those already reported and of each other, and the orthonormal basis extended by them."""
    new = []
    for v in vectors.T:
        rest = _beside(v[:, None], reported)
        size = float(np.linalg.norm(rest))
        if size > NEW:
            new.append(v)
            reported = np.concatenate([reported, rest / size], axis=1)
    return (np.stack(new, axis=1) if new else vectors[:, :0]), reported


def _beside(vectors: F2, reported: F2) -> F2:
    once = vectors - reported @ (reported.T @ vectors)
    return np.asarray(once - reported @ (reported.T @ once))


def _family(terms: tuple[Term, ...], vectors: F2, factor: F1, *, exact: bool) -> Family:
    used = np.abs(vectors).max(axis=1) > ENTRY
    motions = tuple(dict.fromkeys(t.motion for t, u in zip(terms, used, strict=True) if u))
    return Family(motions, np.where(np.abs(vectors) > ENTRY, vectors, 0.0) * factor[:, None], exact)


HARMLESS = 1e-7
"""Deviation (unit columns, relative to the largest) below which a combination does not move the tool anywhere."""
CURES = 3
TOOLS = ("tool", "aside")


@dataclass(frozen=True)
class HiddenGroup:
    """Combinations of some motions that leave no trace.

    Attributes
    ----------
    motions : tuple of str
    count : int
        Number of independent combinations.
    weights : tuple of (name, value)
        The first combination at the size of a typical machine: coefficients in mm and rad.
    vectors : array, shape (p, count)
        All combinations, coefficients in their own units.
    harmless : bool
        Whether the combinations do not move any tool used, anywhere in the volume (they would move another tool).
    effect_mm : float
        Rms deviation, at the worst point, that these combinations hide on a typical machine, rigid motion removed, mm; 0 if harmless.
    cause, cures, text
        Cause; additions each of which would show all combinations; sentences for the report.
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
    """The best measurement to add. With it, the runs would determine ``rank`` of the ``of`` coefficients."""

    cure: str
    rank: int
    of: int

    @property
    def text(self) -> str:
        """Sentence for the report."""
        return f"{self.cure[:1].upper()}{self.cure[1:]} would raise the rank to {self.rank} of {self.of}."


@dataclass(frozen=True)
class HiddenDirection:
    """Hidden groups, advice, and the largest possible rank of runs with the same tools."""

    groups: tuple[HiddenGroup, ...]
    advice: tuple[Advice, ...]
    reachable: int


def picture(campaign: CampaignLayout, observed: ObservedInformation, prior_sd: F1) -> HiddenDirection:
    """Describe the null space of a campaign; ``prior_sd``: typical size of every coefficient, shape (p,), mm or rad."""
    terms = campaign.terms
    field = _fields(campaign, observed.factor)
    silent = _silent(observed.null_space, field)
    tried = trials(campaign, observed)
    harmful = families(terms, observed.null_space, observed.factor, found=silent)
    groups = [_group(terms, f, observed, tried, _effect(f, field, observed.factor, prior_sd), prior_sd) for f in harmful]
    other_tools = [t for t in tried if t.addition.key in TOOLS]  # combinations that move no tool in use depend on the tool alone
    groups += [_group(terms, f, observed, other_tools, 0.0, prior_sd) for f in families(terms, silent, observed.factor)]
    steps = best_sequence(tried, observed.null_space.shape[1])
    advice = tuple(Advice(a.cure, observed.rank + shown, len(terms)) for a, shown in steps)
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

    These points determine as much as a whole grid: an error motion depends on one axis, and its lever linearly on the others.
    """
    box = inner_box(machine)
    three = np.stack([box[:, 0], box.mean(axis=1), box[:, 1]], axis=1)
    out = []
    for a in range(3):
        along = [three[k] if k != a else np.linspace(box[a, 0], box[a, 1], nodes) for k in range(3)]
        out.append(np.stack(np.meshgrid(*along, indexing="ij"), axis=-1).reshape(-1, 3))
    return np.concatenate(out)


def _silent(null_space: F2, field: F2) -> F2:
    """Hidden combinations that do not move any of the tools in the volume, orthonormal in unit columns, shape (p, m)."""
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
    """Largest rms deviation in the volume from these combinations at typical size, mm."""
    root = _typical(family, prior_sd)
    moved = (field / factor) @ root
    return float(np.sqrt((moved**2).sum(axis=1).reshape(-1, 3).sum(axis=1).max()))


def _typical(family: Family, prior_sd: F1) -> F2:
    """Factor of the prior covariance of these combinations: each column is one standard deviation, in the coefficients' own units."""
    scaled = family.vectors / prior_sd[:, None]
    q, _ = scipy.linalg.qr(scaled, mode="economic", check_finite=False)
    return np.asarray(q * prior_sd[:, None])


def _group(
    terms: tuple[Term, ...], family: Family, observed: ObservedInformation, tried: list[CureTrial], effect_mm: float, prior_sd: F1
) -> HiddenGroup:
    count = family.vectors.shape[1]
    coordinates = scipy.linalg.qr(observed.null_space.T @ (family.vectors / observed.factor[:, None]), mode="economic", check_finite=False)[
        0
    ]
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
    return replace(group, text=" ".join((sentence(terms, family, ending) + ".", _effect_text(group), _cure_text(group, partly))))


def _effect_text(group: HiddenGroup) -> str:
    if group.harmless:
        return "With the tools in use this moves nothing, with another tool it does."
    return f"This may hide {group.effect_mm * 1e3:.2g} µm somewhere in the inner 80 % of the volume."


def _cure_text(group: HiddenGroup, partly: tuple[Addition, int] | None) -> str:
    if group.cures:
        return f"Why: {group.cause}. It would be seen with {' or '.join(group.cures)}."
    if partly is None or not partly[1]:
        return "None of the usual additional measurements alone would show it; combinations of two were not tried."
    return f"No single usual measurement shows all of it; {partly[0].cure} would show {partly[1]} of {group.count} combinations."
