"""What a discovery found as the answer of run-format.md 5 (``abbe-discovery/1``)."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

from abbe.models.discovery.answer import Discovery, NamedEffect, Where
from abbe.models.discovery.case import Case
from abbe.service.campaign_data.decimation import Thinning

FORMAT = "abbe-discovery/1"


def answer_doc(found: Discovery, case: Case, thinning: Thinning | None = None) -> dict[str, Any]:
    """Plain JSON, lengths of gaps in um, predictions of every sealed run in mm; ``thinning``: what became of long runs before."""
    held, fitted = found.gaps.get("holdout"), found.gaps.get("identify")
    doc: dict[str, Any] = {
        "format": FORMAT,
        "case": case.name,
        "verdict": found.verdict,
        "effects": [_effect(e) for e in found.effects],
        "confounded_with": list(found.confounded_with),
        "where": where_doc(found.where),
        "p_value": found.p_value,
        "predictions": {r.path.label: found.predicted_mm[r.path.label].tolist() for r in case.of("sealed")},
    }
    if found.beside:
        doc["beside"] = [{"label": label, "evidence": evidence} for label, evidence in found.beside]
    if found.agreement:
        doc["agreement"] = [asdict(a) for a in found.agreement]
    if found.fitted:
        doc["fitted"] = [asdict(f) for f in found.fitted]
    if found.unseen:
        doc["unseen"] = [asdict(u) for u in found.unseen]
    if thinning is not None:
        doc["thinning"] = thinning.doc()
    if found.next_test is not None:
        t = found.next_test
        doc["next_test"] = {
            "adds": list(t.adds),
            "minutes": t.minutes,
            "expected_separation_sigma": t.expected_separation_sigma,
            "why": t.why,
        } | ({"like": t.like} if t.like else {})
    if fitted is not None:
        doc |= {"rms_before_um": 1e3 * fitted.before_mm, "rms_after_um": 1e3 * fitted.after_mm, "noise_floor_um": 1e3 * fitted.floor_mm}
    if held is not None:
        doc["holdout_rms_um"] = 1e3 * held.after_mm
    return doc


def _effect(e: NamedEffect) -> dict[str, Any]:
    shape = {name: value for name, (value, _) in e.parameters.items()} | {f"u_{name}": u for name, (_, u) in e.parameters.items()}
    return {
        "name": e.name,
        "key": e.key,
        "parameters": {name: v for name, v in ({"strength": e.strength, "u_strength": e.u_strength} | shape).items() if math.isfinite(v)},
        "evidence": e.evidence,
        "alternatives": [label for label, _ in e.alternatives],
        "forms": list(e.forms),
    }


def where_doc(where: Where) -> dict[str, Any]:
    """What is known of the place, without the table of tests."""
    return {k: v for k, v in asdict(where).items() if k != "table" and v not in (None, (), [], "")}
