"""How large several findings of one label are together: their coefficients add up, a size without a sign (an rms, a length) does not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from abbe.models.arrays import F1
from abbe.models.effects.effect import Effect
from abbe.service.campaign_data.packed_arrays import unpacked_covariance

ALIKE = 2.0
"""Non-linear values that differ by less than so many standard uncertainties are the same: their columns are."""
OPPOSITE = -0.8
"""Cosine between two findings' coefficients from which on the later one takes the earlier back; one in part of them is another change."""
FORM = 0.1
"""No machine is true to a formula: standard uncertainty of coefficients from their form, relative, as of a geometry's strength."""


def total(entries: Sequence[dict[str, Any]], effect: Effect | None) -> tuple[float, float]:
    """Strength of all entries of a label together and its standard uncertainty, in the effect's unit.

    Where values agree and no form was needed, the effect's own strength of the summed coefficients, stated whole as the
    entries are (`Effect.unseen`); else, and for an effect that the catalogue does not have, the sum of the strengths.
    """
    u = float(np.hypot.reduce([e["u_strength"] for e in entries]))
    if effect is None or len(entries) == 1 or entries[0]["forms"] or not _addable(entries):
        return float(sum(e["strength"] for e in entries)), u
    values = {name: float(p["value"]) for name, p in entries[-1]["parameters"].items()}
    parts = [_coefficients(e) for e in entries]
    own = [float(effect.strength(c, values)) for c in parts]
    whole = sum(abs(e["strength"]) for e in entries) / max(sum(abs(s) for s in own), 1e-300)
    return whole * float(effect.strength(np.sum(parts, axis=0), values)), u


def cancels(entries: Sequence[dict[str, Any]], by_name: Mapping[str, Effect]) -> bool:
    """Whether the entries of a label are nothing together within their uncertainty: what was found there was mended.

    Strengths of opposite sign cancel as numbers. Sizes without a sign never do, however unsure; their coefficients do where they point
    against each other and what is left is no more than their noise.
    """
    effect = by_name.get(entries[0].get("name", ""))
    strengths = [e["strength"] for e in entries]
    if min(strengths) < 0.0 < max(strengths):
        left, u = total(entries, effect)
        return abs(left) <= 2.0 * u
    if len(entries) == 1 or not _addable(entries):
        return False
    parts = [_coefficients(e) for e in entries]
    before, last = np.sum(parts[:-1], axis=0), parts[-1]
    size = float(np.linalg.norm(before) * np.linalg.norm(last))
    if size == 0.0 or before @ last > OPPOSITE * size:
        return False
    noise = sum(float(np.trace(unpacked_covariance(e["covariance"]))) for e in entries)
    form = (2.0 * FORM * float(np.linalg.norm(before))) ** 2
    return bool(np.sum((before + last) ** 2) <= 4.0 * noise + form)


def _addable(entries: Sequence[dict[str, Any]]) -> bool:
    """Whether all entries have coefficients of the same columns."""
    first = entries[0]
    return bool(first.get("coefficients")) and all(
        len(e.get("coefficients", ())) == len(first["coefficients"]) and e["forms"] == first["forms"] and _alike(e, first) for e in entries
    )


def _alike(a: dict[str, Any], b: dict[str, Any]) -> bool:
    if a["parameters"].keys() != b["parameters"].keys():
        return False
    pairs = [(p, b["parameters"][name]) for name, p in a["parameters"].items()]
    return all(abs(p["value"] - q["value"]) <= ALIKE * float(np.hypot(p.get("u") or 0.0, q.get("u") or 0.0)) for p, q in pairs)


def _coefficients(entry: dict[str, Any]) -> F1:
    return np.asarray(entry["coefficients"], dtype=np.float64)
