"""A wanted uncertainty: how few minutes reach it, or why none do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from models.arrays import F2
from models.planning.information import LASER_SCALE
from models.planning.search import Chosen, Search

COVERAGE = 2.0
"""U = 2 u."""
LONGEST_MIN = 480.0
"""Nobody plans more than a day's work: beyond it the answer is the limit."""
_FOREVER = 1e6
_KNOWN = 1e12


@dataclass(frozen=True, slots=True)
class Goal:
    """What became of a wanted expanded uncertainty.

    Attributes
    ----------
    wanted_mm : float
        Largest U = 2 u of the deviation vector in the inner volume.
    reached : bool
        Whether the plan reaches it.
    minutes_needed : float or None
        Minutes after which it is reached; None: not within `LONGEST_MIN`.
    limit_mm : float
        U that every measurement the planner knows, repeated without end, would leave: no plan comes below it.
    limit_by : str
        What makes the limit, in words.
    """

    wanted_mm: float
    reached: bool
    minutes_needed: float | None
    limit_mm: float
    limit_by: str


def worst_u_mm(information: F2, rows: F2) -> float:
    """Standard uncertainty of the deviation vector at the worst node, mm."""
    half = linalg.solve_triangular(linalg.cholesky(information, lower=True), rows.T, lower=True)
    return float(np.sqrt((half**2).sum(axis=0).reshape(-1, 3).sum(axis=1).max()))


def limit(search: Search, rows: F2) -> tuple[float, str]:
    """Expanded uncertainty (mm) that endless repetition of everything would leave at the worst node, and what makes it."""
    total = np.zeros((search.what.size, search.what.size))
    for test in search.candidates:
        total += search.mounting((test,))
    information = np.eye(search.what.size) + _FOREVER * total
    whole = COVERAGE * worst_u_mm(information, rows)
    known = np.array([n.startswith("bar_length_") or n == LASER_SCALE for n in search.what.names])
    free = COVERAGE * worst_u_mm(information + np.diag(np.where(known, _KNOWN, 0.0)), rows)
    if free < 0.5 * whole:
        return whole, "the calibration of the bars and the laser's wavelength: without a better scale no measurement comes below it"
    return whole, "combinations of error motions that none of these measurements sees"


def shortest(search: Search, rows: F2, wanted_mm: float, budget_min: float, passes: int) -> tuple[Chosen, bool]:
    """The shortest plan found that reaches the goal within the budget, or the best plan for the budget and False."""
    first = minutes_needed(search, rows, wanted_mm, {}, budget_min)
    if first is None:
        chosen = search.exchange(search.best_fill(budget_min), budget_min, passes)
        return chosen, bool(chosen) and _enough(search, rows, chosen, wanted_mm)
    chosen = search.exchange(search.best_fill(first), first, passes)
    if not _enough(search, rows, chosen, wanted_mm):  # the criterion leans on the worst node, it is not the worst node
        chosen = search.exchange(search.best_fill(budget_min), budget_min, passes)
        return chosen, _enough(search, rows, chosen, wanted_mm)
    while True:
        tighter = 0.93 * search.total_min(chosen)
        trial = search.exchange(search.best_fill(tighter), tighter, passes)
        if not trial or not _enough(search, rows, trial, wanted_mm):
            return chosen, True
        chosen = trial


def minutes_needed(search: Search, rows: F2, wanted_mm: float, start: Chosen, longest_min: float = LONGEST_MIN) -> float | None:
    """Minutes at which going on from a plan reaches the goal; None: not within the longest time."""
    chosen = dict(start)
    while True:
        left = longest_min - search.total_min(chosen)
        test = search.best_addition(chosen, left)
        if test is None:
            return None
        chosen[test.mounting] = (*chosen.get(test.mounting, ()), test)
        if _enough(search, rows, chosen, wanted_mm):
            return search.total_min(chosen)


def _enough(search: Search, rows: F2, chosen: Chosen, wanted_mm: float) -> bool:
    return COVERAGE * worst_u_mm(search.information(chosen), rows) <= wanted_mm
