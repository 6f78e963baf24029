"""The result of a search: verdict, strengths with uncertainty, rivals, localization, proposed measurement, gaps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.discovery.agreement import agreements, left_out_gap
from abbe.models.discovery.answer import Discovery, Gap, Localization, NamedEffect, NextTest, Verdict
from abbe.models.discovery.candidate_bank import Pick
from abbe.models.discovery.experiment.additions import blind_spots, judging_run
from abbe.models.discovery.experiment.design import SuspectEffect, propose
from abbe.models.discovery.generic.unnamed_structures import PREFIX, is_unnamed
from abbe.models.discovery.lack import CHANCE, Floor, floors, lack_of_fit, unexplained
from abbe.models.discovery.localization import localize_signal, locate
from abbe.models.discovery.mixed_up import MixedUp
from abbe.models.discovery.residues import companions, leaning, residues, shared, ties, too_smooth
from abbe.models.discovery.selection import EXCLUDED, Rival, Selection, near_waves, u_moment
from abbe.models.discovery.sensors import exchanged_sensor
from abbe.models.discovery.solved_model import SolvedModel, left_over, shares, whole_rest
from abbe.models.discovery.unnamed import Structure, describe_structure, lacking, propose_unnamed, structures, wandering
from abbe.models.discovery.variance.scatter_effects import VarianceFinding, creeping
from abbe.models.discovery.whitened_problem import WhitenedProblem
from abbe.models.effects.effect import Effect, Family
from abbe.models.probability import chi2_above

TRUE_TO_FORM: dict[Family, float] = {"drive": 0.03, "structure": 0.03, "thermal": 0.12, "instrument": 0.05, "geometry": 0.1}
"""Relative standard uncertainty of a strength, by family, because no machine follows a formula exactly. It is largest for thermal effects:
a warming part has several time constants, and a campaign does not see the longest."""
TRUE_TO_FORM_OF = {
    "contour_lag": 0.07,  # a second lag in the loop counts in the sum, but shrinks a circle less: by 12 % for a quarter of the sum
    "bar_thermal": 0.08,  # a hand does not warm a bar equally every time, and balls and joints cool at another rate
    "cyclic_error": 0.1,  # swells along its screw, by a tenth to a third
    "vibration": 0.04,
    "stick_slip": 0.1,  # its teeth are not all of one height
    "beam_outliers": 0.05,
    "ram_sag": 0.05,  # the bending line is not a parabola
    "mirror_tilt": 0.1,  # a mirror is not mounted equally badly every time
    "air_refraction": 0.1,  # the temperature of a hall does not follow a sine
    "dead_path": 0.1,  # the air in the dead path does not warm up at a constant rate
}
"""`TRUE_TO_FORM` of single effects that differ from their family."""
CARRYING = ("modulated", "sensor")
"""Prefixes of the forms that carry part of an effect's size; those of thermal effects are not listed."""
OFFSET = "offset"
"""Prefix of forms whose first column is a constant: the start value of a sensor is not part of the effect."""
TIME_TRUE_TO_FORM = 0.3
"""Relative standard uncertainty of a thermal time constant: of several time constants, a short campaign shows only the short ones."""
REST_SHARE = 0.1
"""If part of the gap has no explanation, a name with less than this share of that part's evidence counts as a residue of that part: an
unknown effect always resembles some name a little. In cases whose effects were all found, no such part remains.
"""
STARTS = 2000.0
"""Assumed number of starts that are compared in a campaign; it bounds the p-value of the best start."""


def true_to_form(name: str, family: Family) -> float:
    """Relative standard uncertainty of an effect's strength that stems from the difference between its true form and its formula."""
    return TRUE_TO_FORM_OF.get(name, TRUE_TO_FORM[family])


def shape_of(pick: Pick, u: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    """Return value and standard uncertainty of each non-linear parameter; `TIME_TRUE_TO_FORM` is included for thermal time constants."""
    times = {"tau_s"} if pick.effect.family == "thermal" else set()
    values = {name: float(pick.values[name]) for name in u}
    return {name: (v, float(np.hypot(u[name], TIME_TRUE_TO_FORM * v)) if name in times else u[name]) for name, v in values.items()}


def strength_of(problem: WhitenedProblem, pick: Pick, c: F1, cov: F2) -> tuple[float, float]:
    """Strength and its standard uncertainty, in the effect's unit, from its coefficients (forms last) and their covariance.

    The uncertainty has four parts: the coefficients (with free non-linear parameters), the true form (`true_to_form`), the share of the
    effect that nothing in the readings shows (`Effect.unseen`), and the choice of a sensor's start value (`as_plain`).
    """
    effect = pick.effect
    plain = as_plain(problem, pick)
    c_plain, cov_plain = plain @ c, plain @ cov @ plain.T
    fitted_strength = float(effect.strength(c_plain, pick.values))
    slope = _slope(effect, c_plain, cov_plain, pick)
    own = float(np.sqrt(max(float(slope @ cov_plain @ slope), 0.0)))
    ratio, u_ratio = effect.unseen
    strength = ratio * fitted_strength
    otherwise = fitted_strength - float(effect.strength(as_plain(problem, pick, offset=False) @ c, pick.values))
    u = float(np.linalg.norm([ratio * own, true_to_form(effect.name, effect.family) * strength, u_ratio * fitted_strength, otherwise]))
    return strength / effect.per_unit, u / effect.per_unit


def _slope(effect: Effect, c: F1, cov: F2, pick: Pick) -> F1:
    """Derivative of the strength with respect to each coefficient."""
    out = np.zeros(c.size)
    for j in range(c.size):
        step = max(1e-4 * abs(c[j]), 1e-3 * float(np.sqrt(max(cov[j, j], 1e-30))))
        ends = [effect.strength(c + s * step * np.eye(c.size)[j], pick.values) for s in (-1, 1)]
        out[j] = (ends[1] - ends[0]) / (2.0 * step)
    return out


def as_plain(problem: WhitenedProblem, pick: Pick, *, offset: bool = True) -> F2:
    """Return the matrix that turns coefficients of a pick (forms included) into coefficients of the plain effect with the nearest signal.

    "Nearest" is by least squares. Shape: (columns of the effect, columns of effect and forms). Only forms that carry part of the effect's
    size are included: an amplitude that changes along the axis, other thermal courses, a followed sensor. Other forms, such as a second
    harmonic or wind-up, do not change the strength. ``offset``: fit the start value of a sensor, too, so that it does not change the
    strength.
    """
    raw = pick.raw(problem)
    k = problem.raw(pick.effect.signal, pick.key, pick.values).shape[1]
    at = k
    for form in pick.forms:
        width = problem.raw(form.signal, pick.key, pick.values).shape[1]
        if pick.effect.family != "thermal" and not form.name.startswith(CARRYING):
            raw[:, at : at + width] = 0.0
        at += width
    if not raw[:, k:].any():
        return np.eye(k, raw.shape[1])
    beside = [problem.raw(f.signal, pick.key, pick.values)[:, :1] for f in pick.effect.forms if offset and f.name.startswith(OFFSET)]
    basis = np.concatenate([raw[:, :k], *beside], axis=1)
    scale = np.linalg.norm(basis, axis=0)
    scale[scale == 0.0] = 1.0
    return np.asarray(np.linalg.lstsq(basis / scale, raw, rcond=1e-9)[0] / scale[:, None])[:k]


@dataclass(frozen=True)
class _Judgement:
    """Findings sorted into named effects, unnamed structures, rejected labels with reasons; ``mean``: indices of named mean effects."""

    mean: tuple[int, ...]
    effects: tuple[NamedEffect, ...]
    unnamed: tuple[Structure, ...]
    verdict: Verdict
    rejected: tuple[tuple[str, str], ...]


def finding(
    problem: WhitenedProblem,
    plain: WhitenedProblem,
    found: Sequence[Selection],
    loud: Sequence[VarianceFinding],
    solved: SolvedModel,
    rivals: Sequence[Sequence[Rival]],
    predicted: tuple[dict[str, F1], dict[str, F1]],
) -> Discovery:
    """Assemble the result of a search.

    Parameters
    ----------
    problem, plain : the problem after the search, with noise estimated together with the findings; the problem before the search.
    found, loud : mean effects and variance effects found. solved, rivals : solution with ``found``, and the rivals of each mean effect.
    predicted : predicted readings of every run by label, mm, without and with the effects.
    """
    case, floor = problem.case, floors(problem)
    calm = np.prod([np.ones(problem.use.size), *(1.0 - creeping(problem.paths, f) for f in loud if f.name == "stick_slip")], axis=0)
    rest = unexplained(problem, [f.pick for f in found], floor, calm)
    judgement = _judge(problem, found, loud, solved, rivals, rest, predicted[1])
    is_named, unnamed = judgement.verdict == "named", judgement.unnamed
    fitted_setups = {r.path.setup for r in problem.runs}
    judged = [r for r in case.runs if r.deviation_mm is not None]
    residuals = [{r.path.label: left_over(r, p[r.path.label], fitted_setups) for r in judged} for p in predicted]
    agreement, unjudged = agreements(problem, solved, predicted[0]) if judgement.verdict == "none" else ((), ())
    location, verdict = locate(plain.paths, tuple(plain.by_run(plain.projection.residual))), judgement.verdict
    vague = verdict == "unknown" and unnamed[0].evidence < REST_SHARE * rest  # a place or time of this little is chance
    lack = lack_of_fit(problem, residuals[0], floor, agreement) if verdict == "none" or vague else None
    if lack is not None:
        verdict, unnamed, location = "unknown", (lacking(lack),), lack
    elif verdict == "unknown":
        location = replace(unnamed[0].location, table=location.table)
    gaps = gaps_of(problem, residuals[0], residuals[1], floor)
    return Discovery(
        verdict=verdict,
        effects=judgement.effects if is_named else (),
        location=location,
        next_test=_next_test(problem, judgement, solved, rivals) if is_named else propose_unnamed(case, unnamed),
        gaps=scattered(gaps) if is_named and judgement.mean and len(judgement.effects) > len(judgement.mean) else gaps,
        residual_before_mm=residuals[0],
        residual_after_mm=residuals[1],
        predicted_mm=predicted[1],
        predicted_before_mm=predicted[0],
        noise_mm={k: f.sd_mm for k, f in floor.items()},
        p_value=_p_value(found, loud, lack),
        theta_names=problem.base.names,
        theta=solved.theta,
        theta_covariance=solved.theta_covariance,
        rejected=(*judgement.rejected, *((u.label, u.title) for u in unnamed if lack is not None)),
        confounded_with=_confounded(judgement.effects) if is_named else (),
        beside=tuple((u.label, u.evidence) for u in unnamed) if is_named else (),
        agreement=agreement,
        unjudged=unjudged,
        unseen=blind_spots(case) if verdict == "none" else (),
        left_out=left_out_gap(problem, solved, floor) if is_named and "holdout" not in gaps else None,
    )


def doubted(found: Discovery, mixed: MixedUp) -> Discovery:
    """Replace a result by the suspicion that some readings have the wrong label. No effect is named before this suspicion is settled."""
    whose = " and ".join(mixed.runs)
    doubt = f"the readings of {whose} are probably {mixed.how}: after the correction, {mixed.remains:.0%} of the misfit of all runs remains"
    location = Localization(runs=mixed.runs, table=found.location.table)
    return replace(
        found, verdict="unknown", doubt=doubt, location=location, next_test=None, rejected=(), agreement=(), unjudged=(), unseen=()
    )


def _judge(
    problem: WhitenedProblem,
    found: Sequence[Selection],
    loud: Sequence[VarianceFinding],
    solved: SolvedModel,
    rivals: Sequence[Sequence[Rival]],
    rest: float,
    predicted: Mapping[str, F1],
) -> _Judgement:
    """Sort the findings into named effects, structures without a name, and residues of other effects or of unexplained residuals.

    ``rest``: evidence, in nats, of the residuals above the noise that all findings leave. ``predicted``: readings with findings, by run.
    """
    companion = companions(problem, found, solved)
    uneven, waves = _uneven(problem, found)
    named = [i for i, f in enumerate(found) if not f.pick.unnamed and i not in companion and f.pick.label not in uneven]
    needed = _needed(problem, solved, named, predicted)
    mean = {i: replace(_named(problem, found[i], solved, i, rivals[i]), needed=needed[i]) for i in named}
    scatter = [_of_scatter(f) for f in loud if not is_unnamed(f.name)]
    names = [*mean.values(), *scatter]
    loudly, without = frozenset(e.label for e in scatter), shared(problem, found)
    smooth = too_smooth(problem, solved, loud, whole_rest(problem, solved))
    left = {**residues(names, loudly, without, smooth), **_parts(names, rest)}
    left |= leaning(problem, found, {*left, *(found[i].pick.label for i in companion)})
    mean = _with_ties(mean, ties([e for e in names if e.label not in left], loudly, without))
    effects = sorted((e for e in (*mean.values(), *scatter) if e.label not in left), key=lambda e: (-e.evidence, e.label))
    wander = wandering(problem)
    least = REST_SHARE * max((w.evidence for w in wander), default=0.0)  # noise that wanders has waves and moments by chance
    shapes = [s for s in structures(problem.case, found, loud) if s.evidence > least]
    unnamed = tuple(sorted((*shapes, *waves, *wander), key=lambda s: (-s.evidence, s.label)))
    verdict = _verdict(sum(e.evidence for e in effects), sum(u.evidence for u in unnamed))
    rejected = [(u.label, describe_structure(u, beside=verdict == "named")) for u in unnamed]
    if verdict == "unknown":
        rejected += [(e.label, f"evidence {e.evidence:.0f}, less than the structures without a name have: not named") for e in effects]
    for i, j in companion.items():
        share_text = f"evidence {found[i].score / 2.0:.0f}: the effect may be only the deviation of {found[j].pick.label} from its formula"
        rejected.append((found[i].pick.label, share_text))
    kept = sorted((i for i, e in mean.items() if e.label not in left), key=lambda i: -found[i].score)
    return _Judgement(tuple(kept), tuple(effects), unnamed, verdict, (*rejected, *left.items()))


def _parts(effects: Sequence[NamedEffect], rest: float) -> dict[str, str]:
    """Return, by label, why not to name an effect: it may be only a part of what all findings leave unexplained (`REST_SHARE`)."""
    return {
        e.label: f"evidence {e.evidence:.0f}, but {rest:.0f} stays unexplained: the effect may be only a part of that"
        for e in effects
        if e.evidence < REST_SHARE * rest
    }


def _with_ties(mean: Mapping[int, NamedEffect], pairs: frozenset[tuple[str, str]]) -> dict[int, NamedEffect]:
    """Add to each effect the named effects that the readings cannot tell from it (`ties`) as alternatives.

    The missing evidence of such an alternative is the evidence of this effect minus the evidence of the other one.
    """

    def with_ties(e: NamedEffect) -> NamedEffect:
        near = [(other.label, e.evidence - other.evidence) for other in mean.values() if (e.label, other.label) in pairs]
        return replace(e, alternatives=tuple(sorted((*near, *e.alternatives), key=lambda rival: rival[1]))) if near else e

    return {i: with_ties(e) for i, e in mean.items()}


def _uneven(problem: WhitenedProblem, found: Sequence[Selection]) -> tuple[frozenset[str], tuple[Structure, ...]]:
    """Find waves that only two close pitches fit: the period is not constant.

    Return the labels of both pitches, and each such wave as a structure without a name.
    """
    labels, waves = set[str](), []
    for i, j in permutations(range(len(found)), 2):
        second, first = found[i].pick, found[j].pick
        if near_waves(second, first):
            pitch = [p.values["pitch_mm"] for p in (first, second)]
            labels |= {first.label, second.label}
            location = localize_signal(
                problem.paths, tuple(np.abs(p).sum(axis=1) for p in first.effect.signal(problem.paths, first.key, first.values))
            )
            location = Localization(
                location.tests,
                (first.key,),
                runs=location.runs,
                period_mm=float(np.mean(pitch)),
                depends_on=("position",),
                shape="its period is not constant",
            )
            waves.append(
                Structure(
                    f"{PREFIX}wave:E{first.key * 2}",
                    "wave along the axis whose period is not constant",
                    found[i].score / 2.0 + found[j].score / 2.0,
                    location,
                )
            )
    return frozenset(labels), tuple(waves)


def _needed(problem: WhitenedProblem, solved: SolvedModel, which: Sequence[int], predicted: Mapping[str, F1]) -> dict[int, float | None]:
    """Return a ratio for each effect, by index: rms residual of the holdout runs without the effect, over the rms with all effects.

    The ratio is None without holdout runs (`NamedEffect.needed`). ``predicted``: readings with all effects, mm, by run.
    """
    fitted_setups = {r.path.setup for r in problem.runs}
    judges = [r for r in problem.case.runs if r.role == "holdout" and r.deviation_mm is not None and r.valid.any()]
    if not judges or not which:
        return dict.fromkeys(which)

    def rms(without: Mapping[str, F1]) -> float:
        left = (left_over(r, predicted[r.path.label] - without.get(r.path.label, 0.0), fitted_setups) for r in judges)
        return float(np.sqrt(np.nanmean(np.concatenate([*left]) ** 2)))

    whole, parts = rms({}), shares(problem, solved)
    return {i: rms(parts[i]) / whole if whole > 0.0 else None for i in which}


def _confounded(effects: Sequence[NamedEffect]) -> tuple[str, ...]:
    """Return the labels of alternatives that lack less than `EXCLUDED` of an effect's chi-square, or that are named effects too (`ties`).

    `NamedEffect.alternatives` also contains weaker alternatives.
    """
    named = {e.label for e in effects}
    near = (label for e in effects for label, deficit in e.alternatives if deficit < EXCLUDED / 2.0 or label in named)
    return tuple(dict.fromkeys(near))


def _verdict(named: float, unnamed: float) -> Verdict:
    """Decide by the larger of the total evidences of named effects and of structures without a name; "none" if both are 0."""
    if named == unnamed == 0.0:
        return "none"
    return "unknown" if unnamed > named else "named"


def _p_value(found: Sequence[Selection], loud: Sequence[VarianceFinding], lack: Localization | None) -> float:
    """Return the smallest p of a lack of fit; else a bound on the probability that noise alone gives the strongest finding.

    Bound for a mean effect: chi-square tail of its gain times the number of starts compared; for a variance effect: exp(-evidence).
    """
    if lack is not None:
        return min((s.p for s in lack.table), default=CHANCE)
    bounds: list[float] = [STARTS * float(chi2_above(f.gain, 2 + len(f.pick.effect.shape) + len(f.pick.forms))) for f in found]
    bounds += [float(np.exp(-f.evidence)) for f in loud]
    return min(1.0, *bounds) if bounds else 1.0


def _named(problem: WhitenedProblem, found: Selection, solved: SolvedModel, i: int, rivals: Sequence[Rival]) -> NamedEffect:
    pick, c, cov = solved.picks[i], solved.coefficients[i], solved.covariance[i]
    strength, u = strength_of(problem, pick, c, cov)
    shape = shape_of(pick, solved.shape_u[i])
    if "t0_s" in shape:
        shape |= {"t0_s": (shape["t0_s"][0], u_moment(problem, solved.picks, i))}
    location = localize_signal(problem.paths, tuple(problem.by_run(pick.raw(problem) @ c)))
    return NamedEffect(
        pick.effect.name, pick.key, strength, u, shape, c, cov, 0.5 * found.score,
        tuple((r.pick.label, 0.5 * r.deficit) for r in rivals), location, tuple(f.name for f in pick.forms),
        sensor_doubt=exchanged_sensor(problem.paths, pick.effect.name, pick.key, pick.values),
    )  # fmt: skip


def _of_scatter(f: VarianceFinding) -> NamedEffect:
    shape = {name: (value, math.nan) for name, value in f.parameters.items()}  # from a grid: no uncertainty is known
    c, u = np.array([f.strength]), float(np.hypot(f.u_strength, true_to_form(f.name, "drive") * f.strength))
    return NamedEffect(f.name, f.key, f.strength, u, shape, c, np.array([[u * u]]), f.evidence, location=f.location)


def _next_test(problem: WhitenedProblem, judged: _Judgement, solved: SolvedModel, rivals: Sequence[Sequence[Rival]]) -> NextTest | None:
    """Propose what best separates the strongest effect that has rivals from its rivals; without rivals, a holdout run."""
    effects = {e.label: e for e in judged.effects}
    for i in judged.mean:
        pick = solved.picks[i]
        suspects = {p.label: p for p in (*solved.picks, *(r.pick for r in rivals[i]))}
        near = [suspects[label] for label, _ in effects[pick.label].alternatives[:3]]
        if not near:
            continue
        plain = as_plain(problem, pick) @ solved.coefficients[i]
        leader = SuspectEffect(pick.effect, pick.key, pick.values, plain)
        others = tuple(SuspectEffect(p.effect, p.key, p.values) for p in near)
        test = propose(problem.case, leader, others, {k: c.sd_mm for k, c in problem.colours.items()})
        if test is not None:
            return test
    return judging_run(problem.case) if judged.mean else None


def scattered(gaps: dict[str, Gap]) -> dict[str, Gap]:
    """Add the scatter of variance effects in the fitted runs to the noise floor of every role.

    Nobody can predict this scatter, so naming its cause closes no gap.
    """
    fitted = gaps["identify"]
    scatter = max(fitted.after_mm**2 - fitted.floor_mm**2, 0.0)
    return {role: replace(g, floor_mm=float(np.sqrt(g.floor_mm**2 + scatter))) for role, g in gaps.items()}


def gaps_of(problem: WhitenedProblem, before: Mapping[str, F1], after: Mapping[str, F1], floor_of: Mapping[str, Floor]) -> dict[str, Gap]:
    """Return the gap of each role ("identify", "holdout") that has a valid reading; ``before``, ``after``: residuals by run, mm."""
    out = {}
    for role in ("identify", "holdout"):
        runs = [r for r in problem.case.runs if r.role == role and r.path.label in before]
        if any(np.isfinite(before[r.path.label]).any() for r in runs):
            rms = [float(np.sqrt(np.nanmean(np.concatenate([res[r.path.label] for r in runs]) ** 2))) for res in (before, after)]
            noise = [(r.path.n, floor_of[r.path.kind].sd_mm) for r in runs if r.path.kind in floor_of]
            floor = float(np.sqrt(sum(n * s * s for n, s in noise) / max(sum(n for n, _ in noise), 1)))
            out[role] = Gap(rms[0], rms[1], floor)
    return out
