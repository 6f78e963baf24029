"""Convert the result of a search to the finding that is stored, reported and drawn."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from abbe.models.arrays import F1
from abbe.models.discovery.answer import Discovery, Gap, NamedEffect
from abbe.models.discovery.case import Case, CaseRun
from abbe.models.effects.effect import Effect
from abbe.service.discovery.discovery_states import with_proof
from abbe.service.domain.discovery_file import FoundThinning
from abbe.service.domain.finding import (
    EffectFound,
    Finding,
    GapUm,
    PackedCovariance,
    PackedReadings,
    ParameterFound,
    RefittedModel,
    RivalEffect,
    RunResidual,
    RunSeries,
    Unnamed,
)


def finding_of(
    found: Discovery, case: Case, effects: tuple[Effect, ...], known_mm: Mapping[str, F1], thinning: FoundThinning | None = None
) -> Finding:
    """Build the finding of a discovery, including the result of the holdout runs.

    Names that holdout runs refute, and that chance could give, are dropped if the present model explains all runs without them.

    ``known_mm``: contribution of the model book's effects, mm by run label, which was subtracted before the search and is added to the
    predictions again. ``thinning``: the decimation of long runs; None if no run was decimated.
    """
    by_name = {e.name: e for e in effects}
    found = replace(found, predicted_mm={label: v + known_mm[label] for label, v in found.predicted_mm.items()})
    finding = Finding(
        case=case.name,
        verdict=found.verdict,
        p_value=found.p_value,
        noise_um={kind: v * 1e3 for kind, v in found.noise_mm.items()},
        gaps={role: _gap(g) for role, g in found.gaps.items() if math.isfinite(g.before_mm + g.after_mm + g.floor_mm)},
        left_out=None if found.left_out is None else _gap(found.left_out),
        runs={r.path.label: _run(found, r) for r in case.runs},
        effects=tuple(effect_found(e, by_name[e.name], by_name) for e in found.effects),
        location=found.location,
        next_test=found.next_test,
        rejected=found.rejected,
        confounded_with=found.confounded_with,
        beside=tuple(Unnamed(label=label, evidence=evidence) for label, evidence in found.beside),
        agreement=found.agreement,
        unjudged=found.unjudged,
        unseen=found.unseen,
        fitted=found.fitted,
        doubt=found.doubt,
        thinning=thinning,
        predictions={r.path.label: tuple(found.predicted_mm[r.path.label].tolist()) for r in case.of("sealed")},
        series={r.path.label: _series(found, r) for r in case.runs},
        model=RefittedModel(
            names=tuple(found.theta_names),
            values=tuple(float(v) for v in found.theta),
            covariance=PackedCovariance.of(found.theta_covariance),
        ),
    )
    proof = with_proof(finding)
    if proof.suspects and found.alone is not None and found.alone.verdict == "none":
        return replace(finding_of(found.alone, case, effects, known_mm, thinning), rejected=proof.rejected)
    return proof


def effect_found(named: NamedEffect, effect: Effect, by_name: Mapping[str, Effect]) -> EffectFound:
    """Combine a named effect with the texts of its catalogue entry."""
    units = {p.name: p.unit for p in effect.shape}
    return EffectFound(
        label=named.label,
        name=named.name,
        key=named.key,
        title=effect.title,
        family=effect.family,
        kind=effect.kind,
        strength=named.strength,
        u_strength=named.u_strength,
        unit=effect.unit,
        parameters={
            n: ParameterFound(value=v, u=u if math.isfinite(u) else None, unit=units.get(n, "")) for n, (v, u) in named.parameters.items()
        },
        forms=named.forms,
        needed=named.needed,
        coefficients=tuple(float(v) for v in named.coefficients),
        covariance=PackedCovariance.of(named.covariance),
        evidence=named.evidence,
        alternatives=tuple(_rival(label, less, by_name) for label, less in named.alternatives),
        remedy=effect.remedy,
        remedy_text=effect.remedy_text,
        signature=effect.signature,
        source=effect.source,
        location=named.location,
        sensor_doubt=named.sensor_doubt,
    )


def _rival(label: str, less: float, by_name: Mapping[str, Effect]) -> RivalEffect:
    name, _, key = label.partition(":")
    title = by_name[name].title if name in by_name else name
    return RivalEffect(label=label, title=f"{title} {key}".strip(), less_evidence=less)


def _gap(gap: Gap) -> GapUm:
    return GapUm(before_um=gap.before_mm * 1e3, after_um=gap.after_mm * 1e3, floor_um=gap.floor_mm * 1e3)


def _run(found: Discovery, run: CaseRun) -> RunResidual:
    label, measured = run.path.label, run.deviation_mm is not None
    return RunResidual(
        test=run.path.test,
        role=run.role,
        readings=run.path.n,
        floor_um=noise_mm_of(found.noise_mm, run.path.kind) * 1e3,
        rms_before_um=rms(found.residual_before_mm[label]) * 1e3 if measured else None,
        rms_after_um=rms(found.residual_after_mm[label]) * 1e3 if measured else None,
    )


def noise_mm_of(noise_mm: Mapping[str, float], kind: str) -> float:
    """Return the noise of one reading of an instrument, mm; if none of its runs was fitted, the noise of the noisiest instrument."""
    return noise_mm.get(kind, max(noise_mm.values()))


def rms(residual_mm: F1) -> float:
    """Return the root mean square of the residuals, mm, without flagged readings (NaN)."""
    kept = residual_mm[np.isfinite(residual_mm)]
    return float(np.sqrt(np.mean(kept**2))) if kept.size else 0.0


def _series(found: Discovery, run: CaseRun) -> RunSeries:
    label = run.path.label
    predicted = PackedReadings.of(found.predicted_mm[label])
    if run.deviation_mm is None:
        return RunSeries(predicted=predicted)
    before, after = found.residual_before_mm[label], found.residual_after_mm[label]
    return RunSeries(predicted=predicted, before=PackedReadings.of(before), after=PackedReadings.of(after))
