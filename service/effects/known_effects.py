"""Effects that a machine's model knows already: what they add to the readings of a campaign."""

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
"""Families that stay with the machine. Heat has its own clock in every campaign, an instrument its own set-up: they are found anew."""


def applies(entry: BookEffect, campaign: str) -> bool:
    """Whether an effect of the model book is expected in a campaign's readings: it moves them, and it lasts or was found in just these."""
    moves = entry.kind == "mean" and len(entry.coefficients) > 0
    return moves and (entry.family in LASTING or entry.origin.campaign == campaign)


def readings_of(entries: Sequence[EffectSize], effects: tuple[Effect, ...], case: Case) -> dict[str, F1]:
    """Reading that known effects cause in every run, mm, by the run's label; runs of the case in their order.

    Raises
    ------
    ModelUnknown
        The catalogue has no such effect (any more), or it has another number of coefficients.
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
    """Which columns the coefficients are of, shape (k,): those that a fitted run shows, where not all of them."""
    everything = np.ones(columns[0].shape[1], dtype=bool)
    if everything.size == count:
        return everything
    shown = np.any([np.abs(c).max(axis=0) > 0.0 for c, one in zip(columns, fitted, strict=True) if one], axis=0)
    return np.asarray(shown) if np.count_nonzero(shown) == count else everything


def _usual(entry: EffectSize, coefficients: F1) -> float:
    """What an instrument's new set-up is expected to have: the mean of the known ones where all agree in sign, else nothing."""
    alike = len(coefficients) > 1 and bool(np.all(coefficients > 0.0) or np.all(coefficients < 0.0))
    return float(np.mean(coefficients)) if entry.family == "instrument" and alike and not entry.forms else 0.0


def _columns(effect: Effect, entry: EffectSize, paths: tuple[Path, ...]) -> list[F2]:
    values = {name: p.value for name, p in entry.parameters.items()}
    forms = {f.name: f.signal for f in effect.forms}
    parts = [effect.signal(paths, entry.key, values)]
    parts += [forms[name](paths, entry.key, values) for name in entry.forms if name in forms]
    return [np.concatenate(of_run, axis=1) for of_run in zip(*parts, strict=True)]


def without(case: Case, known_mm: dict[str, F1]) -> Case:
    """The case with what is known already taken out of its readings."""
    runs = tuple(r if r.deviation_mm is None else replace(r, deviation_mm=r.deviation_mm - known_mm[r.path.label]) for r in case.runs)
    return replace(case, runs=runs)
