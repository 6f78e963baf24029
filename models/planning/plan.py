"""Plan a campaign: set-ups in their order, the uncertainty after each step, and the combinations that remain unobservable.

The uncertainties are the posterior (Bayesian Cramer-Rao) bound of the planned readings, with the temperatures of bars and scales as in the
solution's own budget (`abbe.models.uncertainty.inputs`). They neglect error motions above the planner's order, and take noise and
typical sizes as known, although the solver estimates both from the readings.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from abbe.models.machine import AXES, Machine
from abbe.models.planning.measurements import DiagonalTest, HelixTest, Instruments, Measurement, candidates, expected_run, opening
from abbe.models.planning.problem import PlanningProblem, field_rows, problem, scale_temperature_mm2, uncertainty_mm
from abbe.models.planning.search import COVERAGE, Chosen, Goal, PlanSearch, limit, minutes_needed, shortest
from abbe.models.solvers.assessment import observability
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.priors import Priors

__all__ = ["MeasuringPlan", "PlanStep", "laid_out", "plan_campaign", "uncertainty_mm"]
PLAN_ORDER = 8
"""Highest Legendre order of the error motions in a plan's uncertainty; the prior of orders above 6 is small."""
INNER_SHARE = 0.8
REPORT_NODES = 5
PASSES = 8


def not_observable(what: PlanningProblem, runs: Iterable[RunData]) -> tuple[str, ...]:
    """Sentences about the hidden combinations of a plan's runs, with cause and cure, as in the solver's own report.

    Combinations hidden with this tool come first, then those that only another tool would show, then advised additions.
    """
    tools = what.tools
    found = observability(
        what.machine,
        tuple(runs),
        terms=what.terms,
        priors=what.priors,
        sigma_mm={"bar": tools.bar_noise_mm, "laser": tools.laser_noise_mm},
        floor_mm={"bar": tools.floor_mm, "laser": tools.floor_mm},
    )
    out = [g.text for g in found.hidden if not g.harmless]
    silent = sum(g.count for g in found.hidden if g.harmless)
    if silent:
        tool = ", ".join(f"{v:g}" for v in what.machine.tool_mm)
        out.append(
            f"{silent} of the {len(what.terms)} degrees of freedom of the error motions are not observable: with the tool ({tool}) mm they "
            "move nothing, with another tool they would. The plan's uncertainties hold for this tool only."
        )
    return (*out, *(a.text for a in found.advice))


@dataclass(frozen=True, slots=True)
class PlanStep:
    """One measurement of a plan.

    Attributes
    ----------
    label, setup_id : str
        Name of the run; name of its set-up, which consecutive steps can share.
    test : HelixTest, DiagonalTest or LineTest
    role : "identify", or "holdout" for the run that is not fitted and lowers no uncertainty.
    minutes, until_min : float
        Set-up and machine time of this step; time of the plan up to the end of this step.
    u_worst_mm, u_mean_mm : float
        Standard uncertainty of the deviation vector (rigid motion removed) after this step: at the worst node, and the root mean square
        over the nodes of the inner volume.
    """

    label: str
    setup_id: str
    test: Measurement
    minutes: float
    until_min: float
    u_worst_mm: float
    u_mean_mm: float
    role: Literal["identify", "holdout"] = "identify"


@dataclass(frozen=True)
class MeasuringPlan:
    """A planned campaign.

    Attributes
    ----------
    machine : Machine
    tools : Instruments
    steps : tuple of PlanStep
        Steps in the order of measuring: the set-up that gains most per minute comes first. One step is the holdout run (`judge`).
    runs : tuple of RunData
        The runs of a perfect machine: positions, directions, times and weights of the block means, deviations zero.
    u_before_mm : tuple of two floats
        Worst and mean standard uncertainty from the priors alone.
    u_temperature_mm : float
        Largest standard uncertainty of a node from the temperature of the scales: part of every figure above; no measurement reduces it.
    open_questions : tuple of str
        Sentences about combinations of error motions that the plan cannot observe, with cause and cure.
    goal : Goal or None
        Result for the wanted uncertainty; None if no uncertainty was wanted.
    warnings : tuple of str
        Points that the operator must check before anything moves.
    """

    machine: Machine
    tools: Instruments
    steps: tuple[PlanStep, ...]
    runs: tuple[RunData, ...]
    u_before_mm: tuple[float, float]
    u_temperature_mm: float = 0.0
    open_questions: tuple[str, ...] = ()
    goal: Goal | None = None
    warnings: tuple[str, ...] = ()

    @property
    def recipes(self) -> tuple[Measurement, ...]:
        """The measurements alone, in order."""
        return tuple(s.test for s in self.steps)

    @property
    def judge(self) -> PlanStep | None:
        """The holdout run; None if the minutes are too few."""
        return next((s for s in self.steps if s.role == "holdout"), None)

    @property
    def minutes(self) -> float:
        """Set-up and machine time of the whole plan."""
        return self.steps[-1].until_min if self.steps else 0.0

    @property
    def u_worst_mm(self) -> float:
        """Standard uncertainty at the worst node after the whole plan."""
        return self.steps[-1].u_worst_mm if self.steps else self.u_before_mm[0]


def plan_campaign(
    machine: Machine,
    *,
    minutes: float = 60.0,
    goal_mm: float | None = None,
    tools: Instruments | None = None,
    priors: Priors | None = None,
    vertical: int = 2,
    progress: Callable[[float], None] = lambda _: None,
) -> MeasuringPlan:
    """Choose the measurements that are most informative about the deviation over the inner 80 % of the volume, in the available minutes.

    Parameters
    ----------
    minutes : float
        Set-up and machine time together.
    goal_mm : float, optional
        Wanted expanded uncertainty U = 2 u (mm) at the worst node. The plan ends with the step that reaches this value.
    vertical : int
        Index of the vertical axis. Hemispheres open upwards along it if the tool vector does not show where the spindle is.
    progress : callable
        Called with the share that is done, 0 to 1.

    Raises
    ------
    ValueError
        Nothing fits into the strokes or into the minutes.
    """
    if not 0 < minutes < np.inf or (goal_mm is not None and not 0 < goal_mm < np.inf):
        raise ValueError("planner: minutes and goal must be positive numbers")
    what = problem(machine, tools or Instruments(), PLAN_ORDER, priors)
    search = PlanSearch(what, candidates(machine, what.tools, vertical), INNER_SHARE, progress)
    rows = field_rows(search.what, INNER_SHARE, REPORT_NODES)
    if goal_mm is None:
        chosen, reached = search.with_room(search.exchange(search.best_fill(minutes), minutes, PASSES), minutes), False
    else:
        chosen, reached = shortest(search, rows, goal_mm, minutes, PASSES)
    if not chosen:
        raise ValueError(f"planner: no measurement fits into {minutes:g} minutes")
    warning = opening(machine, vertical).warning
    helices = any(isinstance(t, HelixTest) for tests in chosen.values() for t in tests)
    plan = replace(laid_out(search, chosen, minutes, goal_mm if reached else None), warnings=(warning,) if warning and helices else ())
    if goal_mm is None:
        return plan
    floor_mm, limit_by = limit(search, rows)
    if reached:
        needed: float | None = plan.minutes
    else:
        needed = minutes_needed(search, rows, goal_mm, chosen) if floor_mm < goal_mm else None
    return replace(plan, goal=Goal(goal_mm, reached, needed, floor_mm, limit_by))


def laid_out(search: PlanSearch, chosen: Chosen, budget_min: float, goal_mm: float | None = None) -> MeasuringPlan:
    """Turn a choice of measurements into a plan: order them by gain per minute, label them, stop where the goal (U, mm) is reached.

    A holdout run joins one of the mountings if the minutes allow it.
    """
    machine, tools = search.what.machine, search.what.tools
    rows = field_rows(search.what, INNER_SHARE, REPORT_NODES)
    stated = scale_temperature_mm2(search.what, rows)
    steps = _steps(search, chosen)
    enough = [k for k, s in enumerate(steps, start=1) if goal_mm is not None and COVERAGE * s.u_worst_mm <= goal_mm]
    steps = _judged(search, steps[: enough[0]] if enough else steps, budget_min)
    runs = tuple(
        replace(expected_run(machine, s.test, tools, start_s=(s.until_min - s.minutes) * 60.0), label=s.label, setup=s.setup_id)
        for s in steps
    )
    fitted = tuple(run for run, s in zip(runs, steps, strict=True) if s.role == "identify")
    before = uncertainty_mm(np.eye(search.what.size), rows, stated)
    return MeasuringPlan(machine, tools, steps, runs, before, float(np.sqrt(stated.max())), not_observable(search.what, fitted))


def _steps(search: PlanSearch, chosen: Chosen) -> tuple[PlanStep, ...]:
    rows = field_rows(search.what, INNER_SHARE, REPORT_NODES)
    stated = scale_temperature_mm2(search.what, rows)
    total = np.eye(search.what.size)
    steps: list[PlanStep] = []
    until = 0.0
    for number, name in enumerate(_in_order(search, chosen), start=1):
        tests = chosen[name]
        for k, test in enumerate(tests):
            minutes = search.cost_min(test, tests[:k])
            until += minutes
            worst, mean = uncertainty_mm(total + search.mounting(tests[: k + 1]), rows, stated)
            steps.append(PlanStep(_label(test, number, k), f"S{number}", test, minutes, until, worst, mean))
        total += search.mounting(tests)
    return tuple(steps)


def _judged(search: PlanSearch, steps: tuple[PlanStep, ...], budget_min: float) -> tuple[PlanStep, ...]:
    """Insert the holdout run after the last test of its mounting, if it fits into the minutes; later steps then end later."""
    chosen: Chosen = {}
    for s in steps:
        chosen[s.test.mounting] = (*chosen.get(s.test.mounting, ()), s.test)
    test = search.judge(chosen, budget_min)
    if test is None:
        return steps
    at = max(k for k, s in enumerate(steps, start=1) if s.test.mounting == test.mounting)
    last, minutes = steps[at - 1], search.cost_min(test, chosen[test.mounting])
    judge = replace(last, label=f"judge-{last.label}", test=test, minutes=minutes, until_min=last.until_min + minutes, role="holdout")
    return (*steps[:at], judge, *(replace(s, until_min=s.until_min + minutes) for s in steps[at:]))


def _in_order(search: PlanSearch, chosen: Chosen) -> list[str]:
    order: list[str] = []
    done: Chosen = {}
    while len(order) < len(chosen):
        rest = [n for n in chosen if n not in done]
        now = search.criterion(done)
        rates = []
        for n in rest:
            cost = search.total_min({n: chosen[n]})
            rates.append((now - search.criterion({**done, n: chosen[n]})) / max(cost, 1e-6))
        best = rest[int(np.argmax(rates))]
        order.append(best)
        done[best] = chosen[best]
    return order


def _label(test: Measurement, number: int, k: int) -> str:
    if isinstance(test, HelixTest):
        return f"{number:02d}-helix-{test.radius_mm:g}{'abcdefghijklmnop'[k] if k else ''}{'' if test.direction > 0 else '-back'}"
    if isinstance(test, DiagonalTest):
        return f"{number:02d}-step-{test.diagonal}-{test.order}" if test.order else f"{number:02d}-diagonal-{test.diagonal}"
    return f"{number:02d}-line-{AXES[test.axis]}"
