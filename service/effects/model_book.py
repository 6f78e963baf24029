"""The model book: versions of a machine's effects beyond its 21 error motions, the origin of each effect, and reverting.

`readings_of` gives the contribution of the effects in the book to the readings of a campaign.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.discovery.case import Case
from abbe.models.effects.effect import Effect
from abbe.models.effects.path import Path
from abbe.service.domain.discovery import FindingSource
from abbe.service.domain.document import document, record
from abbe.service.domain.finding import EffectFound, EffectSize, Finding
from abbe.service.domain.model_book import BookEffect, ModelBook, ModelVersion, Origin, Provenance
from abbe.service.domain.results import ModelRecord, NewVersion
from abbe.service.errors import ModelUnknown

if TYPE_CHECKING:
    from abbe.service.storage.store import Store

Mask = np.ndarray[tuple[int], np.dtype[np.bool_]]
LASTING = ("drive", "structure", "geometry")
"""Families that stay with the machine. Thermal and instrument effects differ between campaigns and are searched for anew."""


def applies(entry: BookEffect, campaign: str) -> bool:
    """Whether a book effect is expected in a campaign's readings: it shifts readings, and it is lasting or was found in this campaign."""
    moves = entry.kind == "mean" and len(entry.coefficients) > 0
    return moves and (entry.family in LASTING or entry.origin.campaign == campaign)


def readings_of(entries: Sequence[EffectSize], effects: tuple[Effect, ...], case: Case) -> dict[str, F1]:
    """Return the contribution of known effects to the readings of every run, mm, by run label in the order of the case.

    Raises
    ------
    ModelUnknown
        The catalogue no longer has an effect, or has it with another number of coefficients.
    """
    total = {r.path.label: np.zeros(r.path.n) for r in case.runs}
    paths = tuple(r.path for r in case.runs)
    by_name = {e.name: e for e in effects}
    for entry in entries:
        effect = by_name.get(entry.name)
        if effect is None:
            raise ModelUnknown(
                f"the model contains {entry.label}, which is not in the catalogue",
                "install its plug-in, or go back to an older version: abbe model revert",
            )
        coefficients = np.asarray(entry.coefficients, dtype=np.float64)
        found = _columns(effect, entry, paths)
        shown = _shown(found, coefficients.size, [r.role == "identify" for r in case.runs])
        usual = _usual(entry, coefficients)
        for path, columns in zip(paths, found, strict=True):
            if np.count_nonzero(shown) != coefficients.size:
                raise ModelUnknown(
                    f"{entry.label} has {coefficients.size} coefficients in the model and {columns.shape[1]} in this catalogue",
                    "run abbe discover again with this version of Abbe, or go back to an older version of the model: abbe model revert",
                )
            total[path.label] += columns[:, shown] @ coefficients + usual * columns[:, ~shown].sum(axis=1)
    return total


def _shown(columns: list[F2], count: int, fitted: Sequence[bool]) -> Mask:
    """Return a mask of the columns that the coefficients belong to, shape (k,): all columns, or those that a fitted run excites."""
    everything = np.ones(columns[0].shape[1], dtype=bool)
    if everything.size == count:
        return everything
    shown = np.any([np.abs(c).max(axis=0) > 0.0 for c, one in zip(columns, fitted, strict=True) if one], axis=0)
    return np.asarray(shown) if np.count_nonzero(shown) == count else everything


def _usual(entry: EffectSize, coefficients: F1) -> float:
    """Return the expected coefficient for a new set-up of an instrument: the mean of the known ones if all have one sign, else zero."""
    alike = len(coefficients) > 1 and bool(np.all(coefficients > 0.0) or np.all(coefficients < 0.0))
    return float(np.mean(coefficients)) if entry.family == "instrument" and alike and not entry.forms else 0.0


def _columns(effect: Effect, entry: EffectSize, paths: tuple[Path, ...]) -> list[F2]:
    values = {name: p.value for name, p in entry.parameters.items()}
    forms = {f.name: f.signal for f in effect.forms}
    parts = [effect.signal(paths, entry.key, values)]
    parts += [forms[name](paths, entry.key, values) for name in entry.forms if name in forms]
    return [np.concatenate(of_run, axis=1) for of_run in zip(*parts, strict=True)]


def without(case: Case, known_mm: dict[str, F1]) -> Case:
    """Return the case with the known contributions, mm by run label, subtracted from its readings."""
    runs = tuple(r if r.deviation_mm is None else replace(r, deviation_mm=r.deviation_mm - known_mm[r.path.label]) for r in case.runs)
    return replace(case, runs=runs)


ALIKE = 2.0
"""Values of a non-linear parameter that differ by fewer standard uncertainties than this count as equal, and so do their columns."""
OPPOSITE = -0.8
"""If the cosine between two findings' coefficients is below this, the later finding reverses the earlier one; otherwise it is another
change."""
FORM = 0.1
"""Relative standard uncertainty assumed for coefficients, because no machine follows a formula exactly."""
LOOK = "`abbe model list` shows all versions"
REMEDIES = {
    "table": "compensation tables",
    "control parameter": "a parameter of the control",
    "mechanics": "a fitter",
    "warm up or sensor": "warming up, or a temperature sensor",
    "set-up": "mounting the instrument anew",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelSize:
    """Total strength of all entries of a label and its standard uncertainty, in ``unit``."""

    strength: float
    u: float
    unit: str


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


def total(entries: Sequence[EffectSize], effect: Effect | None) -> LabelSize:
    """Return the total size of several entries of one label: coefficients add up, unsigned sizes (an rms, a length) do not.

    If the entries agree in their non-linear parameters and use the effect's main form, the total is the strength of the summed
    coefficients, scaled to include the part that the present model absorbs (`Effect.unseen`). Otherwise, and for an effect outside the
    catalogue, it is the sum of the strengths.
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
    """Whether the entries of a label add up to zero within their uncertainty, because the cause was repaired.

    Signed strengths cancel as numbers. Entries with unsigned sizes cancel only if their coefficients have opposite directions and the
    remainder does not exceed the noise.
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
    """Whether the coefficients of all entries belong to the same columns."""
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
    """Return all versions of one machine's model, or of all machines' models, oldest first."""
    return [_parsed(one) for one in store.models.all(machine)]


def _parsed(one: ModelRecord) -> ModelVersion:
    book = record(ModelBook, one.doc, f"model version {one.version} of machine {one.machine!r}")
    return ModelVersion(machine=one.machine, version=one.version, discovery_id=one.discovery_id, created_utc=one.created_utc, book=book)


def current(store: Store, machine: str) -> ModelVersion | None:
    """Return the newest version of a machine's model; None without any."""
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
        The catalogue, for adding up several findings of one label (`total`).
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
    """Return the entries without the repaired labels (`cancels`), and these labels."""
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
