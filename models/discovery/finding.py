"""The finding in words that others understand: verdict, strengths with uncertainty, rivals, place, what to measure next, gaps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from abbe.models.arrays import F1
from abbe.models.discovery.agreement import agreements
from abbe.models.discovery.answer import Discovery, Gap, NamedEffect, NextTest, Verdict, Where
from abbe.models.discovery.experiment.design import Suspect, propose
from abbe.models.discovery.experiment.unnamed import propose_unnamed
from abbe.models.discovery.generic.unnamed_structures import is_unnamed
from abbe.models.discovery.lack import CHANCE, Floor, floors, lack_of_fit
from abbe.models.discovery.localization import locate
from abbe.models.discovery.prediction import Solved, left_over, predictions
from abbe.models.discovery.residue import residues
from abbe.models.discovery.rivals import EXCLUDED, Rival
from abbe.models.discovery.selection import Found
from abbe.models.discovery.signal_localization import where_of_signal
from abbe.models.discovery.strength import as_plain, shape_of, strength_of, true_to_form
from abbe.models.discovery.unnamed import Structure, lacking, structures, told_of
from abbe.models.discovery.unseen import unseen
from abbe.models.discovery.variance.scatter_effects import VarianceFinding
from abbe.models.discovery.whitened_problem import Scene
from abbe.models.probability import chi2_above

COMPANION_SHARE, COMPANION_OVERLAP = 0.005, 0.6
"""A name with less evidence than this share of another's, at the same readings, is what the other's formula leaves of its true form."""
STARTS = 2000.0
"""So many starts are compared in a campaign; bounds the p-value of the best."""


@dataclass(frozen=True)
class _Told:
    """What was found, sorted by what is said of it: mean effects (number in the search), all names, structures, and what is not named."""

    mean: tuple[int, ...]
    effects: tuple[NamedEffect, ...]
    unnamed: tuple[Structure, ...]
    verdict: Verdict
    rejected: tuple[tuple[str, str], ...]


def finding(
    scene: Scene, plain: Scene, found: Sequence[Found], loud: Sequence[VarianceFinding], solved: Solved, rivals: Sequence[Sequence[Rival]],
    predicted: tuple[dict[str, F1], dict[str, F1]],
) -> Discovery:  # fmt: skip
    """Everything that was found, for the one who asked.

    Parameters
    ----------
    scene, plain : with the findings' noise, and as the present simulation left it.
    found, loud : effects of the mean, of the scatter. solved, rivals : of ``found``, in its order.
    predicted : reading of every run without and with the effects.
    """
    case, told = scene.case, _told(scene, found, loud, solved, rivals)
    is_named, unnamed = told.verdict == "named", told.unnamed
    seen = {r.path.setup for r in scene.runs}
    judged = [r for r in case.runs if r.deviation_mm is not None]
    residuals = [{r.path.label: left_over(r, p[r.path.label], seen) for r in judged} for p in predicted]
    agreement, unjudged = agreements(scene, solved, predicted[0]) if told.verdict == "none" else ((), ())
    where, verdict, floor = locate(plain.paths, tuple(plain.by_run(plain.space.residual))), told.verdict, floors(scene)
    lack = lack_of_fit(scene, residuals[0], floor, agreement) if verdict == "none" else None
    if lack is not None:
        verdict, unnamed, where = "unknown", (lacking(lack),), lack
    elif verdict == "unknown":
        where = replace(unnamed[0].where, table=where.table)
    return Discovery(
        verdict=verdict,
        effects=told.effects if is_named else (),
        where=where,
        next_test=_next_test(scene, told.mean, solved, rivals) if is_named else propose_unnamed(case, unnamed),
        gaps=gaps_of(scene, residuals[0], residuals[1], floor),
        residual_before_mm=residuals[0],
        residual_after_mm=residuals[1],
        predicted_mm=predicted[1],
        predicted_before_mm=predicted[0],
        noise_mm={k: f.sd_mm for k, f in floor.items()},
        p_value=_p_value(found, loud, lack),
        theta_names=scene.base.names,
        theta=solved.theta,
        theta_covariance=solved.theta_covariance,
        rejected=(*told.rejected, *((u.label, u.title) for u in unnamed if lack is not None)),
        confounded_with=_confounded(told.effects) if is_named else (),
        beside=tuple((u.label, u.evidence) for u in unnamed) if is_named else (),
        agreement=agreement,
        unjudged=unjudged,
        unseen=unseen(case) if verdict == "none" else (),
    )


def _told(
    scene: Scene, found: Sequence[Found], loud: Sequence[VarianceFinding], solved: Solved, rivals: Sequence[Sequence[Rival]]
) -> _Told:
    """Which findings are named, which have no name, which are only what another one leaves."""
    companions = _companions(scene, found, solved)
    named = [i for i, f in enumerate(found) if not f.pick.unnamed and i not in companions]
    needed = _needed(scene, solved, named)
    mean = {i: replace(_named(scene, found[i], solved, i, rivals[i]), needed=needed[i]) for i in named}
    scatter = [_of_scatter(f) for f in loud if not is_unnamed(f.name)]
    left = residues([*mean.values(), *scatter], frozenset(e.label for e in scatter))
    effects = sorted((e for e in (*mean.values(), *scatter) if e.label not in left), key=lambda e: (-e.evidence, e.label))
    unnamed = structures(scene.case, found, loud)
    verdict = _verdict(sum(e.evidence for e in effects), sum(u.evidence for u in unnamed))
    rejected = [(u.label, told_of(u, beside=verdict == "named")) for u in unnamed]
    if verdict == "unknown":
        rejected += [(e.label, f"{e.evidence:.0f} nats, less than what has no name: not named beside it") for e in effects]
    for i, j in companions.items():
        rejected.append((found[i].pick.label, f"{found[i].score / 2.0:.0f} nats: form residue of {found[j].pick.label}"))
    kept = sorted((i for i, e in mean.items() if e.label not in left), key=lambda i: -found[i].score)
    return _Told(tuple(kept), tuple(effects), unnamed, verdict, (*rejected, *left.items()))


def _needed(scene: Scene, solved: Solved, which: Sequence[int]) -> dict[int, float | None]:
    """Rms of the holdout runs without each effect over that with all of them, by its number (`NamedEffect.needed`)."""
    seen = {r.path.setup for r in scene.runs}
    judges = [r for r in scene.case.runs if r.role == "holdout" and r.deviation_mm is not None and r.valid.any()]
    if not judges or not which:
        return dict.fromkeys(which)

    def rms(solution: Solved) -> float:
        read = predictions(scene, solution)
        return float(np.sqrt(np.nanmean(np.concatenate([left_over(r, read[r.path.label], seen) for r in judges]) ** 2)))

    def less(i: int) -> Solved:
        return replace(solved, coefficients=tuple(np.zeros_like(c) if k == i else c for k, c in enumerate(solved.coefficients)))

    whole = rms(solved)
    return {i: rms(less(i)) / whole if whole > 0.0 else None for i in which}


def _confounded(effects: Sequence[NamedEffect]) -> tuple[str, ...]:
    """Rivals that the price rule does not exclude; kin that lie farther behind stay with their effect's alternatives."""
    return tuple(dict.fromkeys(label for e in effects for label, less in e.alternatives if less < EXCLUDED / 2.0))


def _verdict(named: float, unnamed: float) -> Verdict:
    """By the evidence of everything with a name and of everything without."""
    if named == unnamed == 0.0:
        return "none"
    return "unknown" if unnamed > named else "named"


def _p_value(found: Sequence[Found], loud: Sequence[VarianceFinding], lack: Where | None) -> float:
    """Of a lack of fit, the smallest of its table.

    Else a bound on how often noise alone would give the strongest finding: chi-square of its parameters times the starts compared.
    """
    if lack is not None:
        return min((s.p for s in lack.table), default=CHANCE)
    bounds: list[float] = [STARTS * float(chi2_above(f.gain, 2 + len(f.pick.effect.shape) + len(f.pick.forms))) for f in found]
    bounds += [float(np.exp(-f.evidence)) for f in loud]
    return min(1.0, *bounds) if bounds else 1.0


def _companions(scene: Scene, found: Sequence[Found], solved: Solved) -> dict[int, int]:
    """Findings that are only what another one's formula leaves of its true form: which, and of which."""
    power = []
    for pick, c in zip(solved.picks, solved.coefficients, strict=True):
        size = scene.white(pick.raw(scene) @ c[:, None])[:, 0] ** 2
        power.append(np.sqrt(size / max(size.sum(), 1e-300)))
    out: dict[int, int] = {}
    for i, small in enumerate(found):
        for j, big in enumerate(found):
            if small.score < COMPANION_SHARE * big.score and not big.pick.unnamed and power[i] @ power[j] > COMPANION_OVERLAP:
                out[i] = j
    return out


def _named(scene: Scene, found: Found, solved: Solved, i: int, rivals: Sequence[Rival]) -> NamedEffect:
    pick, c, cov = solved.picks[i], solved.coefficients[i], solved.covariance[i]
    strength, u = strength_of(scene, pick, c, cov)
    shape = shape_of(pick, solved.shape_u[i])
    where = where_of_signal(scene.paths, tuple(scene.by_run(pick.raw(scene) @ c)))
    return NamedEffect(
        pick.effect.name, pick.key, strength, u, shape, c, cov, 0.5 * found.score,
        tuple((r.pick.label, 0.5 * r.less) for r in rivals), where, tuple(f.name for f in pick.forms),
    )  # fmt: skip


def _of_scatter(f: VarianceFinding) -> NamedEffect:
    shape = {name: (value, math.nan) for name, value in f.parameters.items()}  # from a grid: no uncertainty is known
    c, u = np.array([f.strength]), float(np.hypot(f.u_strength, true_to_form(f.name, "drive") * f.strength))
    return NamedEffect(f.name, f.key, f.strength, u, shape, c, np.array([[u * u]]), f.evidence, where=f.where)


def _next_test(scene: Scene, kept: Sequence[int], solved: Solved, rivals: Sequence[Sequence[Rival]]) -> NextTest | None:
    """What tells the most doubtful name from its rivals best."""
    for i in kept:
        if not rivals[i]:
            continue
        pick = solved.picks[i]
        plain = as_plain(scene, pick) @ solved.coefficients[i]
        leader = Suspect(pick.effect, pick.key, pick.values, plain)
        others = tuple(Suspect(r.pick.effect, r.pick.key, r.pick.values) for r in rivals[i][:3])
        test = propose(scene.case, leader, others, {k: c.sd_mm for k, c in scene.colours.items()})
        if test is not None:
            return test
    return None


def gaps_of(scene: Scene, before: Mapping[str, F1], after: Mapping[str, F1], floor_of: Mapping[str, Floor]) -> dict[str, Gap]:
    """Of every role with at least one reading that counts."""
    out = {}
    for role in ("identify", "holdout"):
        runs = [r for r in scene.case.runs if r.role == role and r.path.label in before]
        if any(np.isfinite(before[r.path.label]).any() for r in runs):
            rms = [float(np.sqrt(np.nanmean(np.concatenate([res[r.path.label] for r in runs]) ** 2))) for res in (before, after)]
            noise = [(r.path.n, floor_of[r.path.kind].sd_mm) for r in runs if r.path.kind in floor_of]
            floor = float(np.sqrt(sum(n * s * s for n, s in noise) / max(sum(n for n, _ in noise), 1)))
            out[role] = Gap(rms[0], rms[1], floor)
    return out
