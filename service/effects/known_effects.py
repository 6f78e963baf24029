"""Effects that a machine's model already contains, and their contribution to the readings of a campaign."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.discovery.case import Case
from abbe.models.effects.effect import Effect
from abbe.models.effects.path import Path
from abbe.service.domain.finding import EffectSize
from abbe.service.domain.model_book import BookEffect
from abbe.service.errors import ModelUnknown

Mask = np.ndarray[tuple[int], np.dtype[np.bool_]]
LASTING = ("drive", "structure", "geometry")
"""Families that stay with the machine. Thermal and instrument effects differ between campaigns and are searched for anew."""


def applies(entry: BookEffect, campaign: str) -> bool:
    """Whether a book effect is expected in a campaign's readings: it shifts readings, and it is lasting or was found in this campaign."""
    moves = entry.kind == "mean" and len(entry.coefficients) > 0
    return moves and (entry.family in LASTING or entry.origin.campaign == campaign)


def readings_of(entries: Sequence[EffectSize], effects: tuple[Effect, ...], case: Case) -> dict[str, F1]:
    """Contribution of known effects to the readings of every run, mm, by run label in the order of the case.

    Raises
    ------
    ModelUnknown
        The catalogue no longer has the effect, or the effect has another number of coefficients.
    """
    total = {r.path.label: np.zeros(r.path.n) for r in case.runs}
    paths = tuple(r.path for r in case.runs)
    by_name = {e.name: e for e in effects}
    for entry in entries:
        effect = by_name.get(entry.name)
        if effect is None:
            raise ModelUnknown(
                f"the model knows {entry.label}, the catalogue does not",
                "install the plug-in it came from, or go back: abbe model revert",
            )
        coefficients = np.asarray(entry.coefficients, dtype=np.float64)
        found = _columns(effect, entry, paths)
        shown = _shown(found, coefficients.size, [r.role == "identify" for r in case.runs])
        usual = _usual(entry, coefficients)
        for path, columns in zip(paths, found, strict=True):
            if np.count_nonzero(shown) != coefficients.size:
                raise ModelUnknown(
                    f"{entry.label} has {coefficients.size} coefficients in the model and {columns.shape[1]} in this catalogue",
                    "run abbe discover again with this version, or go back: abbe model revert",
                )
            total[path.label] += columns[:, shown] @ coefficients + usual * columns[:, ~shown].sum(axis=1)
    return total


def _shown(columns: list[F2], count: int, fitted: Sequence[bool]) -> Mask:
    """Mask of the columns that the coefficients belong to, shape (k,): all of them, or those that a fitted run excites."""
    everything = np.ones(columns[0].shape[1], dtype=bool)
    if everything.size == count:
        return everything
    shown = np.any([np.abs(c).max(axis=0) > 0.0 for c, one in zip(columns, fitted, strict=True) if one], axis=0)
    return np.asarray(shown) if np.count_nonzero(shown) == count else everything


def _usual(entry: EffectSize, coefficients: F1) -> float:
    """Expected coefficient of an instrument's new set-up: the mean of the known ones if all have one sign, else zero."""
    alike = len(coefficients) > 1 and bool(np.all(coefficients > 0.0) or np.all(coefficients < 0.0))
    return float(np.mean(coefficients)) if entry.family == "instrument" and alike and not entry.forms else 0.0


def _columns(effect: Effect, entry: EffectSize, paths: tuple[Path, ...]) -> list[F2]:
    values = {name: p.value for name, p in entry.parameters.items()}
    forms = {f.name: f.signal for f in effect.forms}
    parts = [effect.signal(paths, entry.key, values)]
    parts += [forms[name](paths, entry.key, values) for name in entry.forms if name in forms]
    return [np.concatenate(of_run, axis=1) for of_run in zip(*parts, strict=True)]


def without(case: Case, known_mm: dict[str, F1]) -> Case:
    """The case with the known contributions, mm by run label, subtracted from its readings."""
    runs = tuple(r if r.deviation_mm is None else replace(r, deviation_mm=r.deviation_mm - known_mm[r.path.label]) for r in case.runs)
    return replace(case, runs=runs)
