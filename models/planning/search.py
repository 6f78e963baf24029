"""Choose measurements for the available minutes, greedily by gain per minute and then by exchanges; find the minutes for a goal.

The criterion is I-optimal: the variance of the predicted deviation, rigid motion removed, over the inner volume, as a power mean over the
nodes, which lies between the plain mean (power 1) and the worst node (infinite power). The temperature of the scales is left out, because
no choice of measurements changes it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
import scipy

from abbe.models.arrays import F1, F2
from abbe.models.planning.measurements import (
    ORDERS,
    DiagonalTest,
    HelixTest,
    LineTest,
    Measurement,
    SetupMinutes,
    bars_that_fit,
    machine_seconds,
)
from abbe.models.planning.problem import (
    BAR_SCALE,
    LASER_SCALE,
    PlanningProblem,
    factor,
    field_rows,
    mounting_information,
    scale_temperature_mm2,
    uncertainty_mm,
)

POWER = 4.0
"""Power of the mean over the nodes: high enough that the worst node dominates, low enough that every step still gains something."""
SEARCH_NODES = 4
THRIFTS = (1.0, 0.5, 0.0)
"""Exponents of the minutes in gain / minutes^thrift: 1 prefers cheap measurements, 0 large gains."""
LOOK_AT_ALL = 4
"""All candidates are evaluated at every fourth addition; in between, only the best third of the previous evaluation."""

Chosen = dict[str, tuple[Measurement, ...]]
"""Tests of each mounting (`HelixTest.mounting`), in the order in which they were chosen."""
COVERAGE = 2.0
"""Coverage factor: U = 2 u."""
JUDGE_SHARE = 0.05
"""Largest share of the minutes for the holdout run, which lowers no uncertainty."""
JUDGE_LOSS = 0.1
"""Largest relative increase of the plan's uncertainty for the sake of the holdout run."""
LONGEST_MIN = 480.0
"""Longest plan considered, one day's work; for a goal that needs more, only the limit is reported (`Goal`)."""
_FOREVER = 1e6
_KNOWN = 1e12


def extra_minutes(minutes: SetupMinutes, machine_min: float, test: Measurement, before: tuple[Measurement, ...]) -> float:
    """Set-up and machine minutes of a test whose mounting already has the tests ``before``."""
    if isinstance(test, HelixTest):
        if not before:
            return minutes.cup + machine_min
        last = before[-1]
        same = isinstance(last, HelixTest) and last.radius_mm == test.radius_mm
        return (0.0 if same else minutes.bar) + machine_min
    if before:
        return machine_min
    return (minutes.line if isinstance(test, LineTest) else minutes.diagonal) + machine_min


@dataclass
class PlanSearch:
    """Search of one planning problem; caches the information of every mounting."""

    what: PlanningProblem
    candidates: tuple[Measurement, ...]
    share: float = 0.8
    tick: Callable[[float], None] = lambda _: None
    _rows: F2 = field(init=False)
    _known: frozenset[Measurement] = field(init=False)
    _information: dict[tuple[Measurement, ...], F2] = field(init=False, default_factory=dict)
    _factors: dict[tuple[tuple[Measurement, ...], Measurement], F2] = field(init=False, default_factory=dict)
    _machine_min: dict[Measurement, float] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        """Lay out the nodes at which plans are judged."""
        self._known = frozenset(self.candidates)
        self._rows = field_rows(self.what, self.share, SEARCH_NODES)

    def cost_min(self, test: Measurement, before: tuple[Measurement, ...]) -> float:
        """Minutes of a test whose mounting already has the tests ``before``."""
        if test not in self._machine_min:
            self._machine_min[test] = machine_seconds(self.what.machine, test, self.what.tools) / 60.0
        return extra_minutes(self.what.tools.setup, self._machine_min[test], test, before)

    def total_min(self, chosen: Chosen) -> float:
        """Minutes of a whole plan."""
        return sum(self.cost_min(t, tests[:k]) for tests in chosen.values() for k, t in enumerate(tests))

    def information(self, chosen: Chosen) -> F2:
        """Information of the prior and all mountings together, shape (size, size)."""
        total = np.eye(self.what.size)
        for tests in chosen.values():
            total += self.mounting(tests)
        return total

    def mounting(self, tests: tuple[Measurement, ...]) -> F2:
        """Information of one mounting."""
        if tests not in self._information:
            self._information[tests] = mounting_information(self.what, tests)
        return self._information[tests]

    def _gain_factor(self, before: tuple[Measurement, ...], test: Measurement) -> F2:
        key = (before, test)
        if key not in self._factors:
            added = self.mounting((*before, test))
            self._factors[key] = factor(added - self.mounting(before) if before else added)
        return self._factors[key]

    def criterion(self, chosen: Chosen) -> float:
        """Logarithm of the power-mean standard uncertainty (mm) of a plan."""
        half = scipy.linalg.solve_triangular(scipy.linalg.cholesky(self.information(chosen), lower=True), self._rows.T, lower=True)
        return self._judge((half**2).sum(axis=0))

    @staticmethod
    def _judge(variance: F1) -> float:
        v = variance.reshape(-1, 3).sum(axis=1)
        return float(0.5 / POWER * np.log(np.mean(v**POWER)))

    def best_addition(self, chosen: Chosen, budget_min: float) -> Measurement | None:
        """The affordable test with the largest gain per minute; None: nothing fits or gains."""
        ranked = self.ranking(chosen, budget_min, self.candidates)
        return ranked[0] if ranked else None

    def ranking(self, chosen: Chosen, budget_min: float, pool: tuple[Measurement, ...], thrift: float = 1.0) -> list[Measurement]:
        """Rank the affordable tests, both those of the pool and those at cups already chosen: highest gain / minutes^thrift first."""
        costs = self._affordable(chosen, budget_min, pool)
        if not costs:
            return []
        lower = scipy.linalg.cholesky(self.information(chosen), lower=True)
        factors = [self._gain_factor(chosen.get(test.mounting, ()), test) for test in costs]
        ends = np.cumsum([len(f) for f in factors])
        known = scipy.linalg.solve_triangular(lower, np.concatenate([self._rows, *factors]).T, lower=True)  # all tests at once
        half, offered = known[:, : len(self._rows)], known[:, len(self._rows) :].T
        start, seen = (half**2).sum(axis=0), offered @ half
        now, rates = self._judge(start), dict[Measurement, float]()
        for (test, cost), end, f in zip(costs.items(), ends, factors, strict=True):
            at = slice(end - len(f), end)
            s = scipy.linalg.cholesky(np.eye(len(f)) + offered[at] @ offered[at].T, lower=True, check_finite=False)
            reduction = scipy.linalg.solve_triangular(s, seen[at], lower=True, check_finite=False)
            rates[test] = (now - self._judge(start - (reduction**2).sum(axis=0))) / cost**thrift
        return sorted((t for t, r in rates.items() if r > 1e-6), key=lambda t: -rates[t])

    def _affordable(self, chosen: Chosen, budget_min: float, pool: tuple[Measurement, ...]) -> dict[Measurement, float]:
        """Minutes of every test, from the pool or at a cup already chosen, that can come next and fits into the budget."""
        costs = {}
        for test in (*pool, *self._at_cups(chosen)):
            before = chosen.get(test.mounting, ())
            if test in before or (before and isinstance(test, HelixTest) and not _follows(test, before)):
                continue
            cost = self.cost_min(test, before)
            if cost <= budget_min:
                costs[test] = cost
        return costs

    def _at_cups(self, chosen: Chosen) -> list[Measurement]:
        """Tests with other bars, and with the same bar in the other direction, at cups already chosen."""
        found: list[Measurement] = []
        for tests in chosen.values():
            last = tests[-1]
            if isinstance(last, HelixTest):
                others = bars_that_fit(self.what.machine, self.what.tools, last)
                found += [replace(last, radius_mm=r, direction=1) for r in others if r != last.radius_mm]
                found.append(replace(last, direction=-last.direction))
        return [t for t in found if t not in self._known]

    def fill(self, chosen: Chosen, budget_min: float, thrift: float = 1.0) -> Chosen:
        """Add tests by gain per minute (``thrift`` 1) or by gain alone (0) until nothing more fits."""
        chosen = dict(chosen)
        left = budget_min - self.total_min(chosen)
        pool, looks = self.candidates, 0
        while ranked := self.ranking(chosen, left, pool, thrift):
            test = ranked[0]
            before = chosen.get(test.mounting, ())
            left -= self.cost_min(test, before)
            chosen[test.mounting] = (*before, test)
            looks += 1
            # All gains fall alike from step to step, so the best candidates suffice between two full evaluations.
            pool = (
                self.candidates if looks % LOOK_AT_ALL == 0 else tuple(t for t in ranked[: len(self.candidates) // 3] if t in self._known)
            )
        if pool is not self.candidates and self.best_addition(chosen, left) is not None:
            return self.fill(chosen, budget_min, thrift)
        return chosen

    def best_fill(self, budget_min: float) -> Chosen:
        """The best of three ways to fill the time from nothing."""
        return min((self.fill({}, budget_min, thrift) for thrift in THRIFTS), key=self.criterion)

    def exchange(self, chosen: Chosen, budget_min: float, passes: int) -> Chosen:
        """Remove each mounting, and each mounting's last test, in turn and fill the time again; keep every better plan."""
        best = self.criterion(chosen)
        for number in range(passes):
            improved = False
            self.tick(number / passes)
            for smaller, thrift in product(_without_one(chosen), THRIFTS[::2]):
                trial = self.fill(smaller, budget_min, thrift)
                value = self.criterion(trial)
                if value < best - 1e-4:
                    chosen, best, improved = trial, value, True
                    break
            if not improved:
                break
        return chosen

    def judge(self, chosen: Chosen, budget_min: float) -> Measurement | None:
        """Return the holdout run of a plan. It uses a mounting of the plan, so that only the machine, no new set-up, can cause a deviation.

        The run has the longest bar in the other direction, or else another step order of a diagonal. None: no such run fits into the
        remaining minutes and into `JUDGE_SHARE` of all minutes.
        """
        most = min(budget_min - self.total_min(chosen), JUDGE_SHARE * budget_min)
        found = [t for tests in chosen.values() for t in _unused(tests) if self.cost_min(t, tests) <= most]
        return max(found, key=_reach_mm, default=None)

    def with_room(self, chosen: Chosen, budget_min: float) -> Chosen:
        """Make room in a full plan for the longest holdout run (`judge`) that costs at most `JUDGE_LOSS`; else return the same plan."""
        most = self.criterion(chosen) + JUDGE_LOSS
        tried = {-1.0: chosen}
        for smaller in (chosen, *_without_one(chosen)):
            judge = self.judge(smaller, budget_min)
            if judge is not None:
                trial = self.fill(smaller, budget_min - self.cost_min(judge, smaller[judge.mounting]))
                kept = self.judge(trial, budget_min)
                if kept is not None and self.criterion(trial) < min(most, self.criterion(tried.get(_reach_mm(kept), {}))):
                    tried[_reach_mm(kept)] = trial
        return tried[max(tried)]


def _reach_mm(test: Measurement) -> float:
    return test.radius_mm if isinstance(test, HelixTest) else 0.0


def _unused(tests: tuple[Measurement, ...]) -> list[Measurement]:
    """Further measurements that the mounting of ``tests`` allows without a person."""
    last = tests[-1]
    if isinstance(last, HelixTest):
        again: list[Measurement] = [replace(last, direction=-last.direction)]
    else:
        again = [replace(last, order=order) for order in ORDERS] if isinstance(last, DiagonalTest) else []
    return [t for t in again if t not in tests]


def _follows(test: HelixTest, before: tuple[Measurement, ...]) -> bool:
    """Whether a helix can come next at a cup: no bar is mounted twice, and the bar in place can only measure the other direction."""
    last, used = before[-1], [b.radius_mm for b in before if isinstance(b, HelixTest)]
    return isinstance(last, HelixTest) and (
        test.radius_mm not in used or (test.radius_mm == last.radius_mm and test.direction != last.direction)
    )


def _without_one(chosen: Chosen) -> list[Chosen]:
    out: list[Chosen] = []
    for name, tests in chosen.items():
        out.append({k: v for k, v in chosen.items() if k != name})
        if len(tests) > 1:
            out.append({k: (v[:-1] if k == name else v) for k, v in chosen.items()})
    return out


@dataclass(frozen=True, slots=True)
class Goal:
    """Result for a wanted expanded uncertainty.

    Attributes
    ----------
    wanted_mm : float
        Largest U = 2 u of the deviation vector in the inner volume.
    reached : bool
        Whether the plan reaches ``wanted_mm``.
    minutes_needed : float or None
        Minutes after which a plan reaches ``wanted_mm``; None: not within `LONGEST_MIN`.
    limit_mm : float
        U that would remain if every candidate were repeated without end, temperature of the scales included; no plan reaches a smaller U.
    limit_by : str
        Main contribution to the limit, as text.
    """

    wanted_mm: float
    reached: bool
    minutes_needed: float | None
    limit_mm: float
    limit_by: str


def limit(search: PlanSearch, rows: F2) -> tuple[float, str]:
    """Return the U = 2 u (mm) that endless repetition of every candidate leaves at the worst node, and its largest contribution as text."""
    what, total = search.what, np.zeros((search.what.size, search.what.size))
    for test in search.candidates:
        total += search.mounting((test,))
    information, stated = np.eye(what.size) + _FOREVER * total, scale_temperature_mm2(what, rows)
    scales = np.array([n.startswith("bar_length_") or n in (LASER_SCALE, BAR_SCALE) for n in what.names])
    whole = uncertainty_mm(information, rows, stated)[0]
    readings = uncertainty_mm(information, rows)[0]
    unseen = uncertainty_mm(information + np.diag(np.where(scales, _KNOWN, 0.0)), rows)[0]
    shares = {
        "the temperature of the machine's scales on later days, which no measurement shows": whole**2 - readings**2,
        "the calibration of the bars, their temperature and the laser's wavelength": readings**2 - unseen**2,
        "combinations of error motions that none of these measurements shows": unseen**2,
    }
    return COVERAGE * whole, max(shares, key=lambda name: shares[name])


def shortest(search: PlanSearch, rows: F2, wanted_mm: float, budget_min: float, passes: int) -> tuple[Chosen, bool]:
    """The shortest plan found that reaches the goal within the budget, and True; if none does, the best plan for the budget, and False."""
    first = minutes_needed(search, rows, wanted_mm, {}, budget_min)
    if first is None:
        chosen = search.exchange(search.best_fill(budget_min), budget_min, passes)
        return chosen, bool(chosen) and _enough(search, rows, chosen, wanted_mm)
    chosen = search.exchange(search.best_fill(first), first, passes)
    if not _enough(search, rows, chosen, wanted_mm):  # the criterion is a mean over the nodes, the goal concerns the worst node
        chosen = search.exchange(search.best_fill(budget_min), budget_min, passes)
        return chosen, _enough(search, rows, chosen, wanted_mm)
    while True:
        tighter = 0.93 * search.total_min(chosen)
        trial = search.exchange(search.best_fill(tighter), tighter, passes)
        if not trial or not _enough(search, rows, trial, wanted_mm):
            return chosen, True
        chosen = trial


def minutes_needed(search: PlanSearch, rows: F2, wanted_mm: float, start: Chosen, longest_min: float = LONGEST_MIN) -> float | None:
    """Minutes of a plan that extends ``start`` until it reaches the goal; None: not within ``longest_min``."""
    chosen = dict(start)
    while True:
        left = longest_min - search.total_min(chosen)
        test = search.best_addition(chosen, left)
        if test is None:
            return None
        chosen[test.mounting] = (*chosen.get(test.mounting, ()), test)
        if _enough(search, rows, chosen, wanted_mm):
            return search.total_min(chosen)


def _enough(search: PlanSearch, rows: F2, chosen: Chosen, wanted_mm: float) -> bool:
    return COVERAGE * uncertainty_mm(search.information(chosen), rows, scale_temperature_mm2(search.what, rows))[0] <= wanted_mm
