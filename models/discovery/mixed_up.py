"""Readings under the wrong label: whether two runs fit when their readings are exchanged, or one when its readings are reversed.

This comes before any effect is blamed: exchanged readings resemble hysteresis, lags and lost motion of several axes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from abbe.models.arrays import F1
from abbe.models.discovery.whitened_problem import WhitenedProblem

REMAINS = 0.6
"""Readings are mixed up if less than this share of the misfit of the whole campaign remains with them put right ..."""
ALONE = 0.5
"""... and no correction of other runs explains this share of what the best one explains."""


@dataclass(frozen=True)
class MixedUp:
    """Runs with the wrong readings, what was done to them (``how``), and the share of the campaign's misfit that remains put right."""

    runs: tuple[str, ...]
    how: str
    remains: float


def mixed_up(problem: WhitenedProblem) -> MixedUp | None:
    """Find the runs of a problem whose readings are exchanged or reversed; None if putting no run right explains most of the misfit.

    ``problem``: readings whitened about the present simulation, before any search.
    """
    tried = list(_tried(problem))
    if not tried:
        return None
    projection = problem.projection
    columns = problem.white(np.column_stack([change for _, _, change in tried]))
    y = projection.y[:, None] + columns
    coordinates = projection.y_coordinates[:, None] + projection.coordinates(columns)
    left = ((y * y).sum(axis=0) - (coordinates * coordinates).sum(axis=0)) / max(projection.chi2, 1e-300)
    best = int(np.argmin(left))
    runs, how, _ = tried[best]
    others = [float(v) for v, (names, _, _) in zip(left, tried, strict=True) if not set(names) & set(runs)]
    if left[best] > REMAINS or 1.0 - min(others, default=1.0) > ALONE * (1.0 - left[best]):
        return None
    return MixedUp(runs, how, float(left[best]))


def _tried(problem: WhitenedProblem) -> Iterator[tuple[tuple[str, ...], str, F1]]:
    """Yield runs, what is the matter with them, and the change of all stacked readings, mm, that puts them right."""
    ends = np.cumsum(problem.lengths)
    at = [slice(end - n, end) for n, end in zip(problem.lengths, ends, strict=True)]
    read = [r.data().deviation_mm for r in problem.runs]
    for k, run in enumerate(problem.runs):
        change = np.zeros(problem.gap.size)
        change[at[k]] = read[k][::-1] - read[k]
        yield (run.path.label,), "in the reverse order", change
    for i, j in combinations(range(len(at)), 2):
        one, other = problem.runs[i].path, problem.runs[j].path
        if one.n == other.n and one.kind == other.kind:
            change = np.zeros(problem.gap.size)
            change[at[i]], change[at[j]] = read[j] - read[i], read[i] - read[j]
            yield (one.label, other.label), "exchanged", change
