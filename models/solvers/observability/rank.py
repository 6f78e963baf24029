"""Observed information of a campaign: rank and hidden combinations of the coefficients, status of every parameter and error motion, and
how strongly each run shows a motion.

Convention: columns of unit length, unknown set-up errors projected out, singular values counted down to 1e-9 (rank) and 1e-3 (effective
rank) of the largest. Priors are not used, because typical sizes are not measured. Measured or certified knowledge of the set-up
(`Knowledge`) counts like readings: a calibrated bar, a laser whose drift the maker states.

The rank does not depend on the functions that describe the error motions. The effective rank does: it is higher with Legendre polynomials,
which are nearly independent of each other on the readings, than with powers of the position.

The value of a parameter in a hidden combination comes from the prior, however small its uncertainty. An error motion may be written into a
table of its own only if it is observed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import scipy

from abbe.models.arrays import F1, F2
from abbe.models.geometry.bases import DIRECTIONS, Term, term_values
from abbe.models.machine import Machine
from abbe.models.solvers.least_squares import EFFECTIVE_TOLERANCE, HIDDEN, RANK_TOLERANCE, project_out, svd, taking_part, unit_columns
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe import NEAR_BEAM, STRAIGHT_MM, SetupUnknowns, bar_length_name, run_design, setup_unknowns, straight_line_of
from abbe.models.solvers.priors import Priors

BAR_TRAVEL_MM = 1.0
"""Measuring range of a usual ball-bar to either side of its nominal length."""
HAND_SET = ("cup", "tilt", "zero", "pose", "turn", "form", "scale", "stylus", "lobing")
"""Set-up unknowns that no run states; together with uncalibrated bar lengths they are free in every rank analysis.
All others have a stated limit: slow drifts, the laser's wavelength, its cosine error (`abbe.models.solvers.priors`). These count as known
for the rank and add to every uncertainty. Otherwise a wavelength good to 0.3e-6 would hide every scale, and a drift of the cup (linear in
time, like the height of a helix) would hide a squareness."""
ROUNDING = 1e-6
"""Columns shorter than this fraction of the longest one count as zero. The longest columns are levers of about 1000 mm, so such a column is
a lever of 1 um or a direction cosine of 0.001, from rounded positions, tools and pivots. By such a column a motion of typical size
(20 urad, 5 um) changes a reading by at most 5 nm. Columns of observed motions are longer than 1e-4 of the longest."""
NOTHING = 1e-7
"""Entries of unit vectors below this are rounding."""
Status = Literal["observed", "weak", "not observable"]
OBSERVED, WEAKLY_OBSERVED = 0.9, 0.1
"""Share of a parameter's information that comes from the readings: with 0.9 or more (u at most 0.32 of the prior standard deviation) it is
observed, below 0.1 (u at least 0.95 of the prior standard deviation) not observable, in between weak.
"""
CORRELATED = 0.9
NODES = 41


def as_meant(run: RunData) -> RunData:
    """Remove rounding from the positions of a run, so that rounding does not count in the rank.

    A nearly straight path (`STRAIGHT_MM`) becomes straight and lies along its beam (`NEAR_BEAM`); an axis that hardly moves is at rest;
    step diagonals stay as they are. Positions of a ball-bar run move onto the sphere of the nominal length, from which rounding, chords and
    block means differ by at most `BAR_TRAVEL_MM`. Off the sphere, a common scale and the bar's length would differ in the eighth digit,
    and the rank would count that difference.
    """
    if run.kind == "bar":
        return replace(run, axes_mm=_resting(_on_the_sphere(run)))
    if run.kind == "artefact":
        return run
    line = straight_line_of(run.axes_mm)
    if line is None or run.beam is None or not line[1].any():
        return replace(run, axes_mm=_resting(run.axes_mm))
    middle, along = line
    straight = middle + np.outer((run.axes_mm - middle) @ along, along)
    near = float(np.linalg.norm(np.cross(along, run.beam))) <= NEAR_BEAM
    return replace(run, axes_mm=straight, start_mm=None, beam=along * np.sign(along @ run.beam) if near else run.beam)


def _on_the_sphere(run: RunData) -> F2:
    """Positions of a ball-bar run moved to the nominal distance from the cup, if all lie within the bar's measuring range."""
    assert run.centre_mm is not None
    assert run.radius_mm is not None
    bar = _resting(run.axes_mm) - run.centre_mm
    length = np.linalg.norm(bar, axis=1, keepdims=True)
    if np.abs(length - run.radius_mm).max() > BAR_TRAVEL_MM:
        return run.axes_mm
    return np.asarray(run.centre_mm + bar * (run.radius_mm / length))


def _resting(axes_mm: F2) -> F2:
    """Positions in which every axis that moves by less than `STRAIGHT_MM` rests at its mean."""
    middle = axes_mm.mean(axis=0)
    return np.where(np.abs(axes_mm - middle).max(axis=0) < STRAIGHT_MM, middle, axes_mm)


@dataclass(frozen=True)
class Knowledge:
    """Known facts of the set-up besides the readings, for the rank only.

    Attributes
    ----------
    fixed : mapping of set-up unknown to array, shape (number of terms,)
        Known set-up errors: zero, or this combination of the machine's errors (a mirror squared to the machine's Z line has the tilt of
        that line).
    shared : tuple of tuples of names
        Groups of unknowns that are equal, e.g. the lengths of one sensor with two calibrated extension bars.
    lost_motion : bool
        Whether the machine may have lost motion. The papers' models have none.
    """

    fixed: Mapping[str, F1] = field(default_factory=dict)
    shared: tuple[tuple[str, ...], ...] = ()
    lost_motion: bool = True


@dataclass(frozen=True)
class CampaignColumns:
    """Readings of a campaign per unit of the terms (``machine``, (n, p)), the lost motion (``lost``, (n, 3)) and the set-up (n, k)."""

    machine: F2
    lost: F2
    setup: F2
    setup_names: tuple[str, ...]


@dataclass(frozen=True)
class ObservedInformation:
    """Information of the readings about the machine.

    Attributes
    ----------
    rank, effective_rank : int
        Singular values above 1e-9 and 1e-3 of the largest.
    condition : float
        Largest over smallest singular value counted in ``rank``.
    factor : array, shape (p,)
        Coefficient in its own unit = factor times its value in unit columns.
    singular : array, shape (p,)
        Singular values of the design with unit columns, set-up projected out.
    row_space, null_space : array, shape (p, rank) and (p, p - rank)
        Orthonormal combinations (unit columns) that the readings show, and those that leave no trace.
    """

    rank: int
    effective_rank: int
    condition: float
    factor: F1
    singular: F1
    row_space: F2
    null_space: F2


def campaign_columns(machine: Machine, terms: tuple[Term, ...], runs: tuple[RunData, ...], setup: SetupUnknowns) -> CampaignColumns:
    """Linearised readings of all runs without rounding (`as_meant`), unweighted, because the rank does not depend on the noise."""
    a = np.concatenate([run_design(machine, terms, as_meant(run), setup) for run in runs])
    p = len(terms)
    return CampaignColumns(a[:, :p], a[:, p : p + len(DIRECTIONS)], a[:, p + len(DIRECTIONS) :], setup.names)


def compressed(columns: CampaignColumns) -> CampaignColumns:
    """The same information in no more rows than columns (QR), so that later work does not depend on the number of readings."""
    whole = np.concatenate([columns.machine, columns.lost, columns.setup], axis=1)
    unit, factor = unit_columns(whole)
    if whole.shape[0] > whole.shape[1]:
        unit = scipy.linalg.qr(unit, mode="r", check_finite=False)[0][: whole.shape[1]]
    r = unit / factor
    p = columns.machine.shape[1]
    return CampaignColumns(r[:, :p], r[:, p : p + 3], r[:, p + 3 :], columns.setup_names)


def stated_knowledge(terms: tuple[Term, ...], runs: tuple[RunData, ...], setup_names: tuple[str, ...]) -> Knowledge:
    """Set-up unknowns that count as known: lengths of calibrated bars, and all others except those of `HAND_SET`.

    A bar counts as calibrated if every run with it says so or states its uncertainty, and no run says the opposite
    (`abbe.models.solvers.priors.bar_length_sd`). The calibration's uncertainty affects the uncertainties, not the rank. Cup offsets, mirror
    tilts, laser zeros and uncalibrated lengths are free, however narrow their priors are.
    """
    vague = {bar_length_name(r.radius_mm) for r in runs if r.radius_mm is not None and not _calibrated(r)}
    return Knowledge({n: np.zeros(len(terms)) for n in setup_names if n.partition("_")[0] not in HAND_SET and n not in vague})


def _calibrated(run: RunData) -> bool:
    return run.length_calibrated is True or (run.length_calibrated is None and run.u_length_mm is not None)


def perfect_setup(known: Knowledge, terms: tuple[Term, ...], setup: SetupUnknowns, kinds: tuple[str, ...] = HAND_SET) -> Knowledge:
    """Add to the knowledge that all set-up unknowns of these kinds (``"cup"``, ``"tilt"``, ``"bar_length"``) are zero, as papers assume."""
    more = {n: np.zeros(len(terms)) for n in setup.names if n.startswith(tuple(f"{k}_" for k in kinds))}
    return replace(known, fixed={**known.fixed, **more}, shared=tuple(g for g in known.shared if not set(g) & set(more)))


def with_knowledge(columns: CampaignColumns, known: Knowledge) -> tuple[F2, F2, tuple[tuple[str, ...], ...]]:
    """Machine columns, columns of the free unknowns (set-up and lost motion), and the names of the unknowns behind each free column."""
    machine, at = columns.machine, {n: i for i, n in enumerate(columns.setup_names)}
    for name, combination in known.fixed.items():
        if combination.any():
            machine = machine + np.outer(columns.setup[:, at[name]], combination)
    tied = {n for group in known.shared for n in group}
    groups: list[tuple[str, ...]] = [(n,) for n in columns.setup_names if n not in known.fixed and n not in tied]
    groups += [tuple(n for n in group if n in at) for group in known.shared]
    free = [columns.setup[:, [at[n] for n in group]].sum(axis=1, keepdims=True) for group in groups]
    if known.lost_motion:
        free.append(columns.lost)
        groups += [(f"backlash_{a}",) for a in DIRECTIONS]
    return machine, np.concatenate([columns.setup[:, :0], *free], axis=1), tuple(groups)


def observed_information(columns: CampaignColumns, known: Knowledge) -> ObservedInformation:
    """Rank and null space of the machine's coefficients, with free set-up unknowns and lost motion projected out.

    Raises
    ------
    ValueError
        ``known`` names a set-up unknown that the campaign does not have.
    """
    strangers = set(known.fixed) | {n for group in known.shared for n in group}
    if strangers - set(columns.setup_names):
        raise ValueError(f"observability: {', '.join(sorted(strangers - set(columns.setup_names)))} is not a set-up unknown of these runs")
    machine, free, _ = with_knowledge(columns, known)
    unit, factor = unit_columns(_without_rounding(machine))
    _, s, vt = svd(project_out(unit, free), full_matrices=True)
    s = np.concatenate([s, np.zeros(unit.shape[1] - s.size)])
    top = float(s[0]) if s.size else 0.0
    rank = int((s > RANK_TOLERANCE * top).sum())
    condition = top / float(s[rank - 1]) if rank else float("inf")
    effective = int((s > EFFECTIVE_TOLERANCE * top).sum())
    return ObservedInformation(rank, effective, condition, factor, np.asarray(s), vt[:rank].T, vt[rank:].T)


def _without_rounding(a: F2) -> F2:
    """The design with columns of mere rounding (`ROUNDING`) set to zero; scaled to unit length, such columns would count as observed."""
    norm = np.linalg.norm(a, axis=0)
    return np.where(norm > ROUNDING * norm.max(initial=0.0), a, 0.0)


@dataclass(frozen=True)
class Play:
    """Hidden combinations of the campaign, together with the changes of free unknowns that cancel them.

    Attributes
    ----------
    groups : tuple of tuples of names
        Names behind each free unknown.
    machine, free : arrays, shape (p, k) and (q, k)
        Coefficients of each hidden combination, and the changes of the free unknowns that cancel it, own units.
    loose : array, shape (q, m)
        Changes of free unknowns alone that leave no trace, own units.
    size : array, shape (q, 1)
        Value of each free unknown that corresponds to 1 in unit columns.
    """

    groups: tuple[tuple[str, ...], ...]
    machine: F2
    free: F2
    loose: F2
    size: F2


def play(columns: CampaignColumns, known: Knowledge, observed: ObservedInformation) -> Play:
    """Joint null space of machine and free unknowns, from the machine's null space (`observed_information`)."""
    machine, free, groups = with_knowledge(columns, known)
    unit, factor = unit_columns(free)
    u, s, vt = svd(unit, full_matrices=True)
    rank = int((s > RANK_TOLERANCE * s[0]).sum()) if s.size else 0
    hidden = observed.null_space * observed.factor[:, None]
    answer = vt[:rank].T @ ((u[:, :rank].T @ (machine @ hidden)) / s[:rank, None])
    loose = np.where(np.abs(vt[rank:].T) > NOTHING, vt[rank:].T, 0.0)  # rounding must not count as an unknown of its own
    return Play(groups, hidden, -answer * factor[:, None], loose * factor[:, None], factor[:, None])


def hidden_free(columns: CampaignColumns, known: Knowledge, observed: ObservedInformation) -> frozenset[str]:
    """Names of free unknowns that take part in hidden combinations.

    Among them is the lost motion of axes that never reverse, like the pole axis of one helix.
    """
    found = play(columns, known, observed)
    share = np.linalg.norm(np.concatenate([found.free, found.loose], axis=1) / found.size, axis=1)
    return frozenset(n for group, s in zip(found.groups, share, strict=True) if s > HIDDEN for n in group)


@dataclass(frozen=True, slots=True)
class ParameterStatus:
    """One unknown: estimate (None before solving), standard uncertainty, prior standard deviation, in mm, rad or mm/s.

    ``share``: fraction of the information that comes from the readings, 1 - (u / prior)^2; ``status``: by `OBSERVED` and `WEAKLY_OBSERVED`,
    but always ``"not observable"`` for a parameter that takes part in a hidden combination.
    """

    name: str
    value: float | None
    u: float
    prior: float
    share: float
    status: Status


@dataclass(frozen=True, slots=True)
class Correlation:
    """Two unknowns with correlated errors: ``r`` above 0.9 in magnitude."""

    first: str
    second: str
    r: float


@dataclass(frozen=True, slots=True)
class MotionStatus:
    """One error motion as a function over its stroke, or one squareness.

    ``share``: as for a parameter (`ParameterStatus`), with the mean variance over the stroke; ``u``: rms standard uncertainty over the
    stroke, mm or rad; ``hidden``: coefficients that take part in hidden combinations; ``status``: as for a parameter; ``reason``: why the
    motion may not be written into a table, empty if it may.
    """

    name: str
    share: float
    u: float
    hidden: tuple[str, ...]
    status: Status
    reason: str


def status_of(share: float, *, hidden: bool) -> Status:
    """Return the status of a parameter; ``share``: part of its information that the readings give, 0 to 1; the prior gives the rest."""
    if hidden or share < WEAKLY_OBSERVED:
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
    """Names of the coefficients that take part in a combination that the runs do not show.

    ``null_space``: orthonormal basis of these k combinations, for columns scaled to length 1, shape (p, k).
    """
    return taking_part(tuple(t.name for t in terms), null_space)


def motions(machine: Machine, terms: tuple[Term, ...], covariance: F2, prior: F2, hidden: frozenset[str]) -> tuple[MotionStatus, ...]:
    """Every error motion and squareness of the model, judged as a function over its stroke.

    Parameters
    ----------
    covariance, prior : array, shape (p, p)
        Covariance of the terms' coefficients after the runs, and before them.
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
        return f"{', '.join(hidden)} cannot be distinguished from other errors by these readings"
    if status == "observed":
        return ""
    return f"only {100.0 * share:.0f} % of its information comes from the readings, the rest is an assumption"


def observable_motions(found: tuple[MotionStatus, ...], *, weak: bool = False) -> tuple[str, ...]:
    """Names of the error motions that may be written into tables of their own, because they rest on readings.

    Such a motion has no coefficient in a hidden combination, and at least 90 % of its information comes from the readings (with ``weak``:
    10 %). Other motions may still be corrected where only the sum of all motions matters: in a grid of the volume for the measured tool.
    """
    return tuple(m.name for m in found if m.status == "observed" or (weak and m.status == "weak"))


LOST = 3
NODES = 41
ROUNDING = 1e-9


def run_sensitivity(machine: Machine, terms: tuple[Term, ...], runs: tuple[RunData, ...]) -> tuple[tuple[str, ...], F2]:
    """Rms change of the readings of each run per unit rms of each motion over its stroke, mean over the motion's shapes.

    The part that unknowns of the set-up (cup, bar, mirror, drift) absorb is removed; the part that other motions could explain stays.

    Returns
    -------
    motions : tuple of str
        Names in the order of the terms.
    sensitivity : array (runs, motions)
        mm per mm, or mm per rad for rotations and squareness.
    """
    nodes = np.stack([np.linspace(lo, hi, NODES) for lo, hi in machine.stroke_mm], axis=1)
    values = term_values(terms, nodes, machine.stroke_mm)
    names = tuple(dict.fromkeys(t.motion for t in terms))
    setup = setup_unknowns(runs, Priors(), machine)
    out = np.zeros((len(runs), len(names)))
    for i, run in enumerate(runs):
        rows = run_design(machine, terms, run, setup)
        own, _ = unit_columns(rows[:, len(terms) + LOST :])
        left, size, _ = np.linalg.svd(own, full_matrices=False)
        taken = left[:, size > ROUNDING]
        rest = rows[:, : len(terms)]
        rest = rest - taken @ (taken.T @ rest)
        for k, name in enumerate(names):
            at = [j for j, t in enumerate(terms) if t.motion == name]
            basis = values[:, at] if terms[at[0]].order else np.ones((1, 1))
            mean_square = basis.T @ basis / len(basis)
            power = np.trace(np.linalg.solve(mean_square, rest[:, at].T @ rest[:, at]))
            out[i, k] = np.sqrt(max(float(power), 0.0) / (len(rest) * len(at)))
    return names, out
