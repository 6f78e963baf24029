"""A finding as JSON in the format ``abbe-discovery/1`` (docs/schemas/discovery.schema.json)."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from abbe.models.discovery.answer import Localization, NextTest
from abbe.service.domain.finding import EffectFound, Finding

FORMAT = "abbe-discovery/1"


def answer_doc(finding: Finding) -> dict[str, Any]:
    """Return a finding as JSON: gaps in µm, predictions of every sealed run in mm."""
    holdout, fitted, test = finding.gaps.get("holdout"), finding.gaps.get("identify"), finding.next_test
    doc: dict[str, Any] = {
        "format": FORMAT,
        "case": finding.case,
        "verdict": finding.verdict,
        "effects": [_effect(e) for e in finding.effects],
        "confounded_with": list(finding.confounded_with),
        "where": location_doc(finding.location),
        "p_value": finding.p_value,
        "predictions": {label: list(values) for label, values in finding.predictions.items()},
        "proved": finding.proved,
        "proof": finding.proof,
    }
    doc |= {"doubt": finding.doubt} if finding.doubt else {}
    for name in ("beside", "agreement", "fitted", "unseen"):
        if found := getattr(finding, name):
            doc[name] = [asdict(one) for one in found]
    doc |= {"suspects": [_effect(e) for e in finding.suspects]} if finding.suspects else {}
    doc |= {"thinning": finding.thinning.model_dump(by_alias=True)} if finding.thinning is not None else {}
    doc |= {"next_test": _next_test(test)} if test is not None else {}
    if fitted is not None:
        doc |= {"rms_before_um": fitted.before_um, "rms_after_um": fitted.after_um, "noise_floor_um": fitted.floor_um}
    doc |= {"left_out": asdict(finding.left_out)} if finding.left_out is not None else {}
    return doc if holdout is None else doc | {"holdout_rms_um": holdout.after_um}


def _effect(e: EffectFound) -> dict[str, Any]:
    values = {name: p.value for name, p in e.parameters.items()}
    unsure = {f"u_{name}": p.u for name, p in e.parameters.items() if p.u is not None}
    doc = {
        "name": e.name,
        "key": e.key,
        "parameters": {"strength": e.strength, "u_strength": e.u_strength} | values | unsure,
        "evidence": e.evidence,
        "alternatives": [rival.label for rival in e.alternatives],
        "forms": list(e.forms),
    }
    doc |= {"sensor_doubt": e.sensor_doubt} if e.sensor_doubt else {}
    return doc if e.proved is None else doc | {"proved": e.proved}


def _next_test(test: NextTest) -> dict[str, Any]:
    doc = {
        "adds": list(test.adds),
        "minutes": test.minutes,
        "expected_separation_sigma": test.expected_separation_sigma,
        "why": test.why,
    }
    return doc | ({"like": test.like} if test.like else {})


def location_doc(location: Localization) -> dict[str, Any]:
    """Return as JSON where a signal was located: the fields that are not empty, without the table of significance tests."""
    return {k: v for k, v in asdict(location).items() if k != "table" and v not in (None, (), [], "")}
