"""A discovery as a document that can be stored, told and drawn without computing it again; µm where people read, mm in packed arrays."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from abbe.models.arrays import F1
from abbe.models.discovery.answer import Discovery, Gap, NamedEffect, NextTest, Where
from abbe.models.discovery.case import Case, CaseRun
from abbe.models.effects.effect import Effect
from abbe.service.campaign_data.decimation import Thinning
from abbe.service.campaign_data.packed_arrays import packed, packed_covariance
from abbe.service.discovery.discovery_answer import answer_doc
from abbe.service.discovery.discovery_states import taken_back

FORMAT = "abbe-finding/1"
INSTRUMENT = {"bar": "ball-bar", "laser": "laser"}


def finding_doc(
    found: Discovery, case: Case, effects: tuple[Effect, ...], known_mm: dict[str, F1], thinning: Thinning | None = None
) -> dict[str, Any]:
    """Everything that is kept of a discovery; ``answer`` is its exchange form (run-format.md 5).

    Parameters
    ----------
    known_mm : what the model book knew already, taken out before; it is added to the predictions again.
    thinning : what became of long runs before the search; None: they were searched as they were read.
    """
    by_name = {e.name: e for e in effects}
    found = replace(found, predicted_mm={label: v + known_mm[label] for label, v in found.predicted_mm.items()})
    doc = {
        "format": FORMAT,
        "verdict": found.verdict,
        "p_value": found.p_value,
        "noise_um": {kind: v * 1e3 for kind, v in found.noise_mm.items()},
        "gaps": {role: _gap(g) for role, g in found.gaps.items() if math.isfinite(g.before_mm + g.after_mm + g.floor_mm)},
        "runs": {r.path.label: _run(found, r) for r in case.runs},
        "effects": [effect_doc(e, by_name[e.name], by_name) for e in found.effects],
        "where": where_doc(found.where),
        "next_test": None if found.next_test is None else _next_test(found.next_test),
        "rejected": [list(pair) for pair in found.rejected],
        "confounded_with": list(found.confounded_with),
        "agreement": [{"run": a.run, "times": a.times, "p": a.p} for a in found.agreement],
        "unjudged": [asdict(u) for u in found.unjudged],
        "unseen": [asdict(u) for u in found.unseen],
        "fitted": [asdict(f) for f in found.fitted],
        "thinning": None if thinning is None else thinning.doc(),
        "answer": answer_doc(found, case, thinning),
        "series": {r.path.label: _series(found, r) for r in case.runs},
        "model": {
            "names": list(found.theta_names),
            "values": [float(v) for v in found.theta],
            "covariance": packed_covariance(found.theta_covariance),
        },
    }
    return taken_back({key: finite(value) for key, value in doc.items()})


def finite(value: Any) -> Any:
    """JSON knows no NaN: what is not known is left out of objects, and null in lists."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items() if not (isinstance(v, float) and not math.isfinite(v))}
    if isinstance(value, list):
        return [None if isinstance(v, float) and not math.isfinite(v) else finite(v) for v in value]
    return value


def effect_doc(named: NamedEffect, effect: Effect, by_name: dict[str, Effect]) -> dict[str, Any]:
    """One named effect with what its catalogue entry tells people."""
    units = {p.name: p.unit for p in effect.shape}
    return {
        "label": named.label,
        "name": named.name,
        "key": named.key,
        "title": effect.title,
        "family": effect.family,
        "kind": effect.kind,
        "strength": named.strength,
        "u_strength": named.u_strength,
        "unit": effect.unit,
        "parameters": {n: {"value": v, "u": u, "unit": units.get(n, "")} for n, (v, u) in named.parameters.items()},
        "forms": list(named.forms),
        "needed": named.needed,
        "coefficients": [float(v) for v in named.coefficients],
        "covariance": packed_covariance(named.covariance),
        "evidence": named.evidence,
        "alternatives": [_rival(label, less, by_name) for label, less in named.alternatives],
        "remedy": effect.remedy,
        "remedy_text": effect.remedy_text,
        "signature": effect.signature,
        "source": effect.source,
        "where": where_doc(named.where),
    }


def _rival(label: str, less: float, by_name: dict[str, Effect]) -> dict[str, Any]:
    name, _, key = label.partition(":")
    title = by_name[name].title if name in by_name else name
    return {"label": label, "title": f"{title} {key}".strip(), "less_evidence": less}


def where_doc(where: Where) -> dict[str, Any]:
    """Where something lives; what is not located is left out."""
    out: dict[str, Any] = {}
    for name in ("tests", "axes", "directions", "runs", "depends_on", "time_s", "position_mm"):
        value = getattr(where, name)
        if value:
            out[name] = list(value)
    if where.shape:
        out["shape"] = where.shape
    for name in ("radius_mm", "period_s", "period_mm", "angular_lobes"):
        value = getattr(where, name)
        if value is not None:
            out[name] = value
    if where.table:
        out["table"] = [{"kind": s.kind, "value": s.value, "statistic": s.statistic, "p": s.p} for s in where.table]
    return out


def _gap(gap: Gap) -> dict[str, float]:
    return {"before_um": gap.before_mm * 1e3, "after_um": gap.after_mm * 1e3, "floor_um": gap.floor_mm * 1e3}


def _next_test(test: NextTest) -> dict[str, Any]:
    return {
        "adds": list(test.adds),
        "separates": list(test.separates),
        "expected_separation_sigma": test.expected_separation_sigma,
        "minutes": test.minutes,
        "why": test.why,
        "like": test.like,
    }


def _run(found: Discovery, run: CaseRun) -> dict[str, Any]:
    label = run.path.label
    doc = {
        "test": run.path.test,
        "role": run.role,
        "readings": run.path.n,
        "floor_um": noise_mm_of(found.noise_mm, run.path.kind) * 1e3,
    }
    if run.deviation_mm is None:
        return doc
    return doc | {
        "rms_before_um": rms(found.residual_before_mm[label]) * 1e3,
        "rms_after_um": rms(found.residual_after_mm[label]) * 1e3,
    }


def noise_mm_of(noise_mm: Mapping[str, float], kind: str) -> float:
    """Noise of one reading of an instrument, mm; the noisiest one's where none of its runs was fitted and nobody knows its own."""
    return noise_mm.get(kind, max(noise_mm.values()))


def rms(residual_mm: F1) -> float:
    """Root mean square of the readings that the instrument did not flag (NaN where it did)."""
    kept = residual_mm[np.isfinite(residual_mm)]
    return float(np.sqrt(np.mean(kept**2))) if kept.size else 0.0


def _series(found: Discovery, run: CaseRun) -> dict[str, Any]:
    label = run.path.label
    out = {"predicted": packed(found.predicted_mm[label])}
    if run.deviation_mm is not None:
        out["before"] = packed(found.residual_before_mm[label])
        out["after"] = packed(found.residual_after_mm[label])
    return out
