"""The model book: versions of what is known of a machine beyond its 21 error motions, where each effect came from, and the way back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from abbe.models.arrays import F1
from abbe.models.effects.effect import Effect
from abbe.service.domain.discovery import FindingSource
from abbe.service.domain.document import document, record
from abbe.service.domain.finding import EffectFound, EffectSize, Finding
from abbe.service.domain.model_book import BookEffect, ModelBook, ModelVersion, Origin, Provenance
from abbe.service.domain.results import ModelRecord, NewVersion
from abbe.service.effects.known_effects import applies
from abbe.service.errors import ModelUnknown
from abbe.service.storage.store import Store

ALIKE = 2.0
"""Non-linear values that differ by less than so many standard uncertainties are the same: their columns are."""
OPPOSITE = -0.8
"""Cosine between two findings' coefficients from which on the later one takes the earlier back; one in part of them is another change."""
FORM = 0.1
"""No machine is true to a formula: standard uncertainty of coefficients from their form, relative, as of a geometry's strength."""
LOOK = "`abbe model list MACHINE` shows what there is"
REMEDIES = {
    "table": "compensation tables",
    "control parameter": "a parameter of the control",
    "mechanics": "a fitter",
    "warm up or sensor": "warming up, or a temperature sensor",
    "set-up": "mounting the instrument anew",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelSize:
    """Strength of all entries of a label together and its standard uncertainty, in ``unit``."""

    strength: float
    u: float
    unit: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """A label that is new, gone or of another size in the second of two versions."""

    label: str
    before: LabelSize | None
    after: LabelSize | None

    @property
    def what(self) -> str:
        """In a word."""
        return "new" if self.before is None else "gone" if self.after is None else "changed"

    @property
    def unit(self) -> str:
        """Of the sizes."""
        size = self.before or self.after
        return "" if size is None else size.unit


def total(entries: Sequence[EffectSize], effect: Effect | None) -> LabelSize:
    """How large several entries of one label are together: coefficients add up, a size without a sign (an rms, a length) does not.

    Where values agree and no form was needed, the effect's own strength of the summed coefficients, stated whole as the
    entries are (`Effect.unseen`); else, and for an effect that the catalogue does not have, the sum of the strengths.
    """
    u, unit = float(np.hypot.reduce([e.u_strength for e in entries])), entries[-1].unit
    if effect is None or len(entries) == 1 or entries[0].forms or not _addable(entries):
        return LabelSize(strength=float(sum(e.strength for e in entries)), u=u, unit=unit)
    values = {name: p.value for name, p in entries[-1].parameters.items()}
    parts = [_coefficients(e) for e in entries]
    own = [float(effect.strength(c, values)) for c in parts]
    whole = sum(abs(e.strength) for e in entries) / max(sum(abs(s) for s in own), 1e-300)
    return LabelSize(strength=whole * float(effect.strength(np.sum(parts, axis=0), values)), u=u, unit=unit)


def cancels(entries: Sequence[EffectSize], by_name: Mapping[str, Effect]) -> bool:
    """Whether the entries of a label are nothing together within their uncertainty: what was found there was mended.

    Strengths of opposite sign cancel as numbers. Sizes without a sign never do, however unsure; their coefficients do where they point
    against each other and what is left is no more than their noise.
    """
    strengths = [e.strength for e in entries]
    if min(strengths) < 0.0 < max(strengths):
        left = total(entries, by_name.get(entries[0].name))
        return abs(left.strength) <= 2.0 * left.u
    if len(entries) == 1 or not _addable(entries):
        return False
    parts = [_coefficients(e) for e in entries]
    before, last = np.sum(parts[:-1], axis=0), parts[-1]
    size = float(np.linalg.norm(before) * np.linalg.norm(last))
    if size == 0.0 or before @ last > OPPOSITE * size:
        return False
    noise = sum(float(np.trace(e.covariance.matrix)) for e in entries if e.covariance is not None)
    form = (2.0 * FORM * float(np.linalg.norm(before))) ** 2
    return bool(np.sum((before + last) ** 2) <= 4.0 * noise + form)


def _addable(entries: Sequence[EffectSize]) -> bool:
    """Whether all entries have coefficients of the same columns."""
    first = entries[0]
    return bool(first.coefficients) and all(
        len(e.coefficients) == len(first.coefficients) and e.forms == first.forms and _alike(e, first) for e in entries
    )


def _alike(a: EffectSize, b: EffectSize) -> bool:
    if a.parameters.keys() != b.parameters.keys():
        return False
    pairs = [(p, b.parameters[name]) for name, p in a.parameters.items()]
    return all(abs(p.value - q.value) <= ALIKE * float(np.hypot(p.u or 0.0, q.u or 0.0)) for p, q in pairs)


def _coefficients(entry: EffectSize) -> F1:
    return np.asarray(entry.coefficients, dtype=np.float64)


def versions(store: Store, machine: str | None = None) -> list[ModelVersion]:
    """All versions of a machine's model, or of all machines, oldest first."""
    return [_parsed(one) for one in store.models.all(machine)]


def _parsed(one: ModelRecord) -> ModelVersion:
    book = record(ModelBook, one.doc, f"model version {one.version} of machine {one.machine!r}")
    return ModelVersion(machine=one.machine, version=one.version, discovery_id=one.discovery_id, created_utc=one.created_utc, book=book)


def current(store: Store, machine: str) -> ModelVersion | None:
    """The newest version of a machine's model; None if its book is empty."""
    found = store.models.all(machine)
    return _parsed(found[-1]) if found else None


def version(store: Store, machine: str, number: int) -> ModelVersion:
    """One version of a machine's model.

    Raises
    ------
    ModelUnknown
        There is no such version, or no book of this machine.
    """
    known = store.models.all(machine)
    found = next((m for m in known if m.version == number), None)
    if found is None:
        have = f"versions 1 to {len(known)}" if known else "no model"
        raise ModelUnknown(f"machine {machine!r} has no version {number}: it has {have}", LOOK)
    return _parsed(found)


def grown(
    base: ModelVersion | None, finding: Finding, source: FindingSource, discovery: int | None, effects: tuple[Effect, ...] = ()
) -> ModelBook:
    """The version that a finding brings: the known effects, and the new ones with the provenance of each.

    An effect that was taken out of the readings before stays and what was found beside it is added; one that is found anew in every
    campaign (heat, instruments) replaces its older entry. What adds up to nothing within its uncertainty was repaired and leaves the book.

    Parameters
    ----------
    discovery : int, optional
        Number of the discovery that found it.
    effects : tuple of Effect
        The catalogue: how large the sum of two findings of one label is (`total`).
    """
    origin = Origin(campaign=source.campaign, discovery=discovery)
    new = [_entry(e, origin) for e in finding.effects]
    labels = {e.label for e in new}
    old = () if base is None else base.book.effects
    kept = [e for e in old if e.label not in labels or applies(e, source.campaign)]
    left, gone = _without_repaired(kept + new, effects)
    return ModelBook(
        parent=None if base is None else base.version,
        why=f"campaign {source.campaign}: " + (", ".join(sorted(labels)) or "nothing new"),
        machine_digest=source.machine_digest,
        effects=left,
        gone=gone,
        model=finding.model,
        provenance=Provenance(campaign=source.campaign, discovery=discovery, runs=source.runs, versions=source.versions),
    )


def _entry(effect: EffectFound, origin: Origin) -> BookEffect:
    shared = {one.name: getattr(effect, one.name) for one in fields(EffectSize)}
    return BookEffect(**shared, origin=origin, rivals=tuple(rival.label for rival in effect.alternatives))


def _without_repaired(entries: list[BookEffect], effects: tuple[Effect, ...]) -> tuple[tuple[BookEffect, ...], tuple[str, ...]]:
    """Entries without the labels whose parts cancel within their uncertainty, and these labels."""
    by_name = {e.name: e for e in effects}
    labels = dict.fromkeys(e.label for e in entries)
    gone = tuple(label for label in labels if cancels([e for e in entries if e.label == label], by_name))
    return tuple(e for e in entries if e.label not in gone), gone


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
    book = replace(old.book, parent=newest.version, why=f"back to version {number}, by hand")
    return store.models.add(NewVersion(machine, newest.version, document(book)))


def differences(first: ModelVersion, second: ModelVersion, effects: tuple[Effect, ...] = ()) -> list[Difference]:
    """What the second version has more, less or of another size than the first, by label; strengths in the effect's unit."""
    by_name = {e.name: e for e in effects}
    before, after = _sizes(first, by_name), _sizes(second, by_name)
    found = [Difference(label=label, before=before.get(label), after=after.get(label)) for label in dict.fromkeys((*before, *after))]
    return [one for one in found if one.before != one.after]


def _sizes(one: ModelVersion, by_name: dict[str, Effect]) -> dict[str, LabelSize]:
    """Size of every label; entries of one label add up."""
    same: dict[str, list[BookEffect]] = {}
    for e in one.book.effects:
        same.setdefault(e.label, []).append(e)
    return {label: total(some, by_name.get(some[0].name)) for label, some in same.items()}


def no_table_lines(known: ModelVersion | None) -> list[str]:
    """Effects of the current model that no static table takes out, with what does: for people who are about to write tables."""
    if known is None:
        return []
    return [
        f"{e.words} (model version {known.version}) is no matter for tables but for {REMEDIES[e.remedy]}: {e.remedy_text}"
        for e in known.book.effects
        if e.remedy != "table"
    ]
