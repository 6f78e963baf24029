"""Sums of the model book's entries: their contribution to the readings of a campaign, their total size, and whether they cancel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.discovery.case import Case
from abbe.models.effects.effect import Effect
from abbe.models.effects.path import Path
from abbe.service.domain.finding import EffectSize
from abbe.service.errors import ModelUnknown

Mask = np.ndarray[tuple[int], np.dtype[np.bool_]]
ALIKE = 2.0
"""Largest difference between values of a non-linear parameter, in standard uncertainties, at which values and columns count as equal."""
OPPOSITE = -0.8
"""If the cosine between two findings' coefficients is below this, the later finding reverses the earlier one; otherwise it is another
change."""
FORM = 0.1
"""Relative standard uncertainty assumed for coefficients, because no machine follows a formula exactly."""


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


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelSize:
    """Total strength of all entries of a label and its standard uncertainty, in ``unit``."""

    strength: float
    u: float
    unit: str


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
