"""A wanted uncertainty: the minutes that reach it, or the reason why none do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F2
from abbe.models.planning.information import BAR_SCALE, LASER_SCALE, scale_temperature_mm2, uncertainty_mm
from abbe.models.planning.search import Chosen, Search

COVERAGE = 2.0
"""U = 2 u."""
LONGEST_MIN = 480.0
"""Longest plan, one day's work: beyond it the answer is the limit."""
_FOREVER = 1e6
_KNOWN = 1e12


@dataclass(frozen=True, slots=True)
class Goal:
    """Result for a wanted expanded uncertainty.

    Attributes
    ----------
    wanted_mm : float
        Largest U = 2 u of the deviation vector in the inner volume.
    reached : bool
        Whether the plan reaches it.
    minutes_needed : float or None
        Minutes after which it is reached; None: not within `LONGEST_MIN`.
    limit_mm : float
        U that every measurement the planner knows, repeated without end, and the temperature of the scales would leave: no plan comes
        below it.
    limit_by : str
        Main contribution to the limit, as text.
    """

    wanted_mm: float
    reached: bool
    minutes_needed: float | None
    limit_mm: float
    limit_by: str


def limit(search: Search, rows: F2) -> tuple[float, str]:
    """Expanded uncertainty (mm) that endless repetition of everything would leave at the worst node, and what makes most of it."""
    what, total = search.what, np.zeros((search.what.size, search.what.size))
    for test in search.candidates:
        total += search.mounting((test,))
    information, stated = np.eye(what.size) + _FOREVER * total, scale_temperature_mm2(what, rows)
    scales = np.array([n.startswith("bar_length_") or n in (LASER_SCALE, BAR_SCALE) for n in what.names])
    whole = uncertainty_mm(information, rows, stated)[0]
    readings = uncertainty_mm(information, rows)[0]
    unseen = uncertainty_mm(information + np.diag(np.where(scales, _KNOWN, 0.0)), rows)[0]
    shares = {
        "the temperature of the machine's scales, which no measurement tells for another day": whole**2 - readings**2,
        "the calibration of the bars, their temperature and the laser's wavelength": readings**2 - unseen**2,
        "combinations of error motions that none of these measurements sees": unseen**2,
    }
    return COVERAGE * whole, max(shares, key=lambda name: shares[name])


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
    return COVERAGE * uncertainty_mm(search.information(chosen), rows, scale_temperature_mm2(search.what, rows))[0] <= wanted_mm
