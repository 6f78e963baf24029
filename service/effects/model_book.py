"""The model book: versions of what is known of a machine beyond its 21 error motions, where each effect came from, and the way back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from abbe.models.arrays import F1
from abbe.models.effects.effect import Effect
from abbe.service.campaign_data.packed_arrays import unpacked_covariance
from abbe.service.domain.results import ModelRecord, NewVersion
from abbe.service.effects.known_effects import applies
from abbe.service.errors import ModelUnknown
from abbe.service.storage.store import Store

# How large several findings of one label are together: their coefficients add up, a size without a sign (an rms, a length) does not.


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


FORMAT = "abbe-model/1"
LOOK = "`abbe model list MACHINE` shows what there is"
REMEDIES = {
    "table": "compensation tables",
    "control parameter": "a parameter of the control",
    "mechanics": "a fitter",
    "warm up or sensor": "warming up, or a temperature sensor",
    "set-up": "mounting the instrument anew",
}


def current(store: Store, machine: str) -> ModelRecord | None:
    """The newest version of a machine's model; None if its book is empty."""
    versions = store.models(machine)
    return versions[-1] if versions else None


def version(store: Store, machine: str, number: int) -> ModelRecord:
    """One version of a machine's model.

    Raises
    ------
    ModelUnknown
        There is no such version, or no book of this machine.
    """
    versions = store.models(machine)
    found = next((m for m in versions if m.version == number), None)
    if found is None:
        have = f"versions 1 to {len(versions)}" if versions else "no model"
        raise ModelUnknown(f"machine {machine!r} has no version {number}: it has {have}", LOOK)
    return found


def grown(base: ModelRecord | None, finding: dict[str, Any], source: dict[str, Any], effects: tuple[Effect, ...] = ()) -> dict[str, Any]:
    """Document of the version that a finding brings: the known effects, and the new ones with the provenance of each.

    An effect that was taken out of the readings before stays and what was found beside it is added; one that is found anew in every
    campaign (heat, instruments) replaces its older entry. What adds up to nothing within its uncertainty was repaired and leaves the book.

    Parameters
    ----------
    source : dict
        ``campaign``, ``machine_digest``, ``runs`` (digests), ``versions``, ``discovery``.
    effects : tuple of Effect
        The catalogue: how large the sum of two findings of one label is (`abbe.service.effects.model_book`).
    """
    origin = {k: source[k] for k in ("campaign", "discovery")}
    new = [_entry(e, origin) for e in finding["effects"]]
    labels = {e["label"] for e in new}
    old = [] if base is None else base.doc["effects"]
    kept = [e for e in old if e["label"] not in labels or applies(e, source["campaign"])]
    left, gone = _without_repaired(kept + new, effects)
    return {
        "format": FORMAT,
        "parent": None if base is None else base.version,
        "why": f"campaign {source['campaign']}: " + (", ".join(sorted(labels)) or "nothing new"),
        "machine_digest": source["machine_digest"],
        "effects": left,
        "gone": gone,
        "model": finding["model"],
        "provenance": {k: source[k] for k in ("campaign", "discovery", "runs", "versions")},
    }


def _entry(effect: dict[str, Any], origin: dict[str, Any]) -> dict[str, Any]:
    told = ("signature", "alternatives")
    return {k: v for k, v in effect.items() if k not in told} | {"from": origin, "rivals": [a["label"] for a in effect["alternatives"]]}


def _without_repaired(entries: list[dict[str, Any]], effects: tuple[Effect, ...]) -> tuple[list[dict[str, Any]], list[str]]:
    """Entries without the labels whose parts cancel within their uncertainty, and these labels."""
    by_name = {e.name: e for e in effects}
    labels = dict.fromkeys(e["label"] for e in entries)
    gone = [label for label in labels if cancels([e for e in entries if e["label"] == label], by_name)]
    return [e for e in entries if e["label"] not in gone], gone


def revert(store: Store, machine: str, number: int) -> int:
    """Make an older version the current one again. Nothing is deleted: it is appended as a new version.

    Raises
    ------
    ModelUnknown
        There is no such version, or it is the current one.
    ModelMovedOn
        A newer version was added meanwhile; nothing is written.
    """
    old, newest = version(store, machine, number), current(store, machine)
    if newest is None or newest.version == number:
        raise ModelUnknown(f"version {number} of machine {machine!r} is the current one", LOOK)
    doc = old.doc | {"parent": newest.version, "why": f"back to version {number}, by hand"}
    return store.add_model(NewVersion(machine, newest.version, doc))


def differences(first: ModelRecord, second: ModelRecord, effects: tuple[Effect, ...] = ()) -> list[dict[str, Any]]:
    """What the second version has more, less or of another size than the first, by label; strengths in the effect's unit."""
    by_name = {e.name: e for e in effects}
    before, after = _sizes(first, by_name), _sizes(second, by_name)
    out = []
    for label in dict.fromkeys((*before, *after)):
        a, b = before.get(label), after.get(label)
        if a != b:
            what = "new" if a is None else "gone" if b is None else "changed"
            unit = (a or b or (0.0, 0.0, ""))[2]
            out.append({"label": label, "what": what, "unit": unit, "before": _size(a), "after": _size(b)})
    return out


def _size(value: tuple[float, float, str] | None) -> dict[str, float] | None:
    return None if value is None else {"strength": value[0], "u": value[1]}


def _sizes(record: ModelRecord, by_name: dict[str, Effect]) -> dict[str, tuple[float, float, str]]:
    """Strength and uncertainty of every label; entries of one label add up."""
    entries = record.doc["effects"]
    same = {label: [e for e in entries if e["label"] == label] for label in dict.fromkeys(e["label"] for e in entries)}
    return {label: (*total(some, by_name.get(some[0].get("name", ""))), some[-1]["unit"]) for label, some in same.items()}


def no_table_lines(record: ModelRecord | None) -> list[str]:
    """Effects of the current model that no static table takes out, with what does: for people who are about to write tables."""
    if record is None:
        return []
    return [
        f"{name_of(e)} (model version {record.version}) is no matter for tables but for {REMEDIES[e['remedy']]}: {e['remedy_text']}"
        for e in record.doc["effects"]
        if e["remedy"] != "table"
    ]


def name_of(entry: dict[str, Any]) -> str:
    """An effect in words: title and where it sits."""
    return f"{entry['title']} {entry['key']}".strip()
