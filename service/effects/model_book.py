"""The model book: versions of a machine's effects beyond its 21 error motions, the origin of each effect, and reverting.

`abbe.service.effects.effect_sums` gives the contribution of the effects in the book to the readings of a campaign, and adds them up.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

from abbe.service.domain.discovery import FindingSource
from abbe.service.domain.document import document, record
from abbe.service.domain.finding import EffectFound, EffectSize, Finding
from abbe.service.domain.model_book import BookEffect, ModelBook, ModelVersion, Origin, Provenance
from abbe.service.domain.results import ModelRecord, NewVersion
from abbe.service.errors import ModelUnknown

if TYPE_CHECKING:
    from abbe.models.effects.effect import Effect
    from abbe.service.effects.effect_sums import LabelSize
    from abbe.service.storage.store import Store

LASTING = ("drive", "structure", "geometry")
"""Families that stay with the machine. Thermal and instrument effects differ between campaigns and are searched for anew."""


def applies(entry: BookEffect, campaign: str) -> bool:
    """Whether a book effect is expected in a campaign's readings: it shifts readings, and it is lasting or was found in this campaign."""
    moves = entry.kind == "mean" and len(entry.coefficients) > 0
    return moves and (entry.family in LASTING or entry.origin.campaign == campaign)


LOOK = "`abbe model list` shows all versions"
REMEDIES = {
    "table": "compensation tables",
    "control parameter": "a parameter of the control",
    "mechanics": "a fitter",
    "warm up or sensor": "warming up, or a temperature sensor",
    "set-up": "mounting the instrument anew",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """A label that the second of two versions adds, drops or resizes."""

    label: str
    before: LabelSize | None
    after: LabelSize | None

    @property
    def what(self) -> str:
        """``new``, ``gone`` or ``changed``."""
        return "new" if self.before is None else "gone" if self.after is None else "changed"

    @property
    def unit(self) -> str:
        """Unit of the sizes."""
        size = self.before or self.after
        return "" if size is None else size.unit


def versions(store: Store, machine: str | None = None) -> list[ModelVersion]:
    """Return all versions of one machine's model, or of all machines' models, oldest first."""
    return [_parsed(one) for one in store.models.all(machine)]


def _parsed(one: ModelRecord) -> ModelVersion:
    book = record(ModelBook, one.doc, f"model version {one.version} of machine {one.machine!r}")
    return ModelVersion(machine=one.machine, version=one.version, discovery_id=one.discovery_id, created_utc=one.created_utc, book=book)


def current(store: Store, machine: str) -> ModelVersion | None:
    """Return the newest version of a machine's model; None if the machine has no model."""
    found = store.models.all(machine)
    return _parsed(found[-1]) if found else None


def version(store: Store, machine: str, number: int) -> ModelVersion:
    """Return one version of a machine's model.

    Raises
    ------
    ModelUnknown
        The machine has no such version, or no model.
    """
    known = store.models.all(machine)
    found = next((m for m in known if m.version == number), None)
    if found is None:
        have = f"versions 1 to {len(known)}" if known else "no model"
        raise ModelUnknown(f"machine {machine!r} has no version {number}: it has {have}", LOOK)
    return _parsed(found)


def extended_book(
    base: ModelVersion | None, finding: Finding, source: FindingSource, discovery: int | None, effects: tuple[Effect, ...] = ()
) -> ModelBook:
    """Return the book after a finding: the known effects and the new ones, each with its provenance.

    An effect that was subtracted from the readings stays, and the finding is added to it. A thermal or instrument effect replaces its older
    entry. A label whose entries cancel within their uncertainty leaves the book: its cause was repaired.

    Parameters
    ----------
    discovery : int, optional
        Number of the discovery that made the finding.
    effects : tuple of Effect
        The catalogue, for adding up several findings of one label (`abbe.service.effects.effect_sums.total`).
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
    """Return the entries without the repaired labels (`abbe.service.effects.effect_sums.cancels`), and these labels."""
    from abbe.service.effects.effect_sums import cancels

    by_name = {e.name: e for e in effects}
    labels = dict.fromkeys(e.label for e in entries)
    gone = tuple(label for label in labels if cancels([e for e in entries if e.label == label], by_name))
    return tuple(e for e in entries if e.label not in gone), gone


def revert(store: Store, machine: str, number: int) -> int:
    """Append a copy of an older version as the current one; nothing is deleted.

    Raises
    ------
    ModelUnknown
        The version does not exist, or is the current one.
    ModelMovedOn
        Another process added a version meanwhile; nothing is written.
    """
    old, newest = version(store, machine, number), current(store, machine)
    if newest is None or newest.version == number:
        raise ModelUnknown(f"version {number} of machine {machine!r} is the current one", LOOK)
    book = replace(old.book, parent=newest.version, why=f"back to version {number}, by hand")
    return store.models.add(NewVersion(machine, newest.version, document(book)))


def differences(first: ModelVersion, second: ModelVersion, effects: tuple[Effect, ...] = ()) -> list[Difference]:
    """Return the labels that the second version adds, drops or resizes; strengths in the effect's unit."""
    by_name = {e.name: e for e in effects}
    before, after = _sizes(first, by_name), _sizes(second, by_name)
    found = [Difference(label=label, before=before.get(label), after=after.get(label)) for label in dict.fromkeys((*before, *after))]
    return [one for one in found if one.before != one.after]


def _sizes(one: ModelVersion, by_name: dict[str, Effect]) -> dict[str, LabelSize]:
    """Return the total size by label."""
    from abbe.service.effects.effect_sums import total  # a list of versions computes nothing

    same: dict[str, list[BookEffect]] = {}
    for e in one.book.effects:
        same.setdefault(e.label, []).append(e)
    return {label: total(some, by_name.get(some[0].name)) for label, some in same.items()}


def no_table_lines(known: ModelVersion | None) -> list[str]:
    """Return one line for each effect of the current model that no static table corrects, with its remedy."""
    if known is None:
        return []
    return [
        f"{e.full_title} (model version {known.version}) needs {REMEDIES[e.remedy]}, not tables: {e.remedy_text}"
        for e in known.book.effects
        if e.remedy != "table"
    ]
