"""One joint solution of ball-bar and laser runs: 21 error motions, lost motion, and every set-up error as an unknown.

Published methods solve the data sets one by one and take the set-ups as perfect. Here cup offsets, bar lengths, mirror tilts, laser zeros
and drifts are unknowns with documented priors (`abbe.models.solvers.priors`), and the solution lists
parameters that the data cannot separate. The noise of the instruments and the size of each class of errors are estimated as well
(docs/decisions/0011-sizes-from-the-data.md).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import wraps
from typing import Concatenate, Literal, ParamSpec, TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.geometry.bases import DIRECTIONS, SMOOTH_ORDER, Term, rough_terms, smooth_terms, term_motions
from abbe.models.geometry.field import field_mm
from abbe.models.machine import Machine, with_tool
from abbe.models.solvers.components import KINDS, total
from abbe.models.solvers.engine import (
    CampaignFit,
    CampaignProblem,
    InstrumentNoise,
    StageSink,
    build,
    expected_noise,
    rough_evidence,
    settle,
    sums_of,
)
from abbe.models.solvers.fine import refined
from abbe.models.solvers.least_squares import Identifiability, ParameterEstimate, combinations_of, taking_part
from abbe.models.solvers.observability.rank import campaign_columns, compressed, hidden_free, observed_information, stated_knowledge
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe import SetupUnknowns
from abbe.models.solvers.order_choice import RIGID6, OrderChoice, choose, regions, term_levels
from abbe.models.solvers.priors import Priors
from abbe.models.solvers.residuals import Outlier, ResidualTest, residual_tests
from abbe.models.solvers.scale_drift import ScaleDrift, drift_factor, scale_drifts

ROUGH_EVIDENCE, ROUGH_POINTS = 5.0, -1.0
"""The solution includes the motions' rough parts if the score for these parts exceeds its expectation by `ROUGH_EVIDENCE` standard
deviations, or by `ROUGH_POINTS` for points of artefacts, which are few.
"""
Model = Literal["rigid6", "rigid21", "auto"]


@dataclass(frozen=True)
class RunFit:
    """Fit of one run: residuals in the order of its (averaged) readings, their rms, and the rms that was expected, mm."""

    label: str
    kind: str
    residual_mm: F1
    rms_mm: float
    expected_mm: float


@dataclass(frozen=True, eq=False)
class JointSolution:
    """Error motions of the machine from all runs together. A solution is immutable, so derived results are cached with it (`kept`).

    Attributes
    ----------
    estimate : ParameterEstimate
        Smooth terms first (in the order of ``terms``), then backlash, then the set-up unknowns. Its covariance includes the estimated noise
        and the uncertainty of the estimated sizes.
    tool_count : int
        Number of different tools in the runs; with one tool, errors that only another tool would show stay hidden.
    data, setup : the runs as used, and their set-up unknowns.
    prior_sd : array, shape (p,)
        Prior standard deviation of every unknown of ``estimate``, with the sizes estimated from these data.
    information : array, shape (p, p)
        Information of the readings alone (A^T W A, no prior), in the unknowns' own units.
    identifiability : Identifiability
        Rank analysis of the terms up to ``order``, with the set-up knowledge of the observability report
        (`abbe.models.solvers.observability.rank.stated_knowledge`); ``involved`` also names lost motion and free set-up unknowns that the
        readings leave open.
    prior_root : array, shape (p, p)
        Factor of the prior covariance of the unknowns, root root^T; it holds the correlations of a motion's orders, ``prior_sd`` does not.
    weight_per_mm2 : array, shape (n,)
        Weight of every reading in ``information``, run by run: robust weight over noise variance, reduced for correlated neighbours.
    order : int
        Highest Legendre order that held-out runs support (or the caller's). Higher terms are nuisance unknowns, so that no interval is too
        narrow because of a truncated basis.
    noise_mm, noise_repeats_mm : dict by kind
        Standard deviation of one raw reading, estimated with the solution, and from repeats alone (None without repeats).
    outliers : down-weighted readings, largest first.
    residual_tests : tests of the whitened residuals per run.
    model : "rigid6" or "rigid21"
    order_choice : scores of all orders on left-out set-ups (model "auto": also on regions); None if the caller chose the order.
    size_factors : dict
        Ratio of estimated to documented typical size for each class of unknowns; ``length``: correlation length, strokes.
    added : dict of array, shape (p, k)
        Factors of parts of the covariance of ``estimate`` that no reading shows, by source: ``table``, an unknown table active during the
        runs; ``scale_drift``, scales that changed meanwhile (`abbe.models.solvers.scale_drift`).
    scale_drifts : the clear change of a scale during the campaign, if there is one.
    """

    machine: Machine
    terms: tuple[Term, ...]
    estimate: ParameterEstimate
    identifiability: Identifiability
    runs: tuple[RunFit, ...]
    tool_count: int
    data: tuple[RunData, ...]
    setup: SetupUnknowns
    prior_sd: F1
    information: F2
    prior_root: F2
    weight_per_mm2: F1
    order: int
    noise_mm: dict[str, float]
    noise_repeats_mm: dict[str, float | None]
    outliers: tuple[Outlier, ...]
    residual_tests: tuple[ResidualTest, ...]
    model: str
    order_choice: OrderChoice | None
    size_factors: dict[str, float]
    added: Mapping[str, F2] = field(default_factory=dict)
    scale_drifts: tuple[ScaleDrift, ...] = ()

    @property
    def has_artefacts(self) -> bool:
        """Whether some of its readings are points of artefacts."""
        return any(run.kind == "artefact" for run in self.data)

    @property
    def only_artefacts(self) -> bool:
        """Whether all its readings are points of artefacts."""
        return all(run.kind == "artefact" for run in self.data)

    @property
    def coefficients(self) -> F1:
        """Coefficients of the smooth terms, shape (len(terms),)."""
        return self.estimate.theta[: len(self.terms)]

    @property
    def term_covariance(self) -> F2:
        """Covariance of the smooth terms' coefficients."""
        n = len(self.terms)
        return self.estimate.covariance[:n, :n]

    def deviation_mm(self, axes_mm: F2, tool_mm: F1 | None = None) -> F2:
        """Predicted deviation without lost motion at commanded positions, shape (n, 3), mm; ``tool_mm`` None: the machine's own tool."""
        terms, coefficients, stroke = self.terms, self.coefficients, self.machine.stroke_mm
        return field_mm(with_tool(self.machine, tool_mm), lambda at: term_motions(terms, coefficients, at, stroke), axes_mm)

    def backlash_mm(self) -> dict[str, tuple[float, float]]:
        """Lost motion of each axis and its standard uncertainty, mm."""
        return {a: (self.estimate.value(f"backlash_{a}"), self.estimate.u(f"backlash_{a}")) for a in DIRECTIONS}


Q = ParamSpec("Q")
T = TypeVar("T")


def kept(make: Callable[Concatenate[JointSolution, Q], T]) -> Callable[Concatenate[JointSolution, Q], T]:
    """Cache a function of a solution and hashable arguments; its results live as long as the solution.

    The results must not refer to the solution, or its memory would never be freed.
    """
    answers: WeakKeyDictionary[JointSolution, dict[tuple[object, ...], T]] = WeakKeyDictionary()

    @wraps(make)
    def asked(solution: JointSolution, /, *args: Q.args, **named: Q.kwargs) -> T:
        mine, key = answers.setdefault(solution, {}), (*args, *named.items())
        if key not in mine:
            mine[key] = make(solution, *args, **named)
        return mine[key]

    return asked


def widened(solution: JointSolution, source: str, factor: F2) -> JointSolution:
    """Return the same solution with one more part of its covariance, factor factor^T (`JointSolution.added`), shape (p, k).

    The standard uncertainty of an unknown grows at most to its prior standard deviation.
    """
    left = np.maximum(solution.prior_sd**2 - solution.estimate.covariance.diagonal(), 0.0)
    size = np.sum(factor**2, axis=1)
    factor = factor * np.sqrt(np.divide(left, size, out=np.ones_like(size), where=size > left))[:, None]
    wider = replace(solution.estimate, covariance=solution.estimate.covariance + factor @ factor.T)
    return replace(solution, estimate=wider, added={**solution.added, source: factor})


def implausible(solution: JointSolution, prior_sd: dict[str, float], limit: float = 5.0) -> list[tuple[str, float]]:
    """Set-up unknowns of more than ``limit`` prior standard deviations: (name, number of standard deviations), largest first.

    A bar length among them means that ball-bar and laser disagree about the length scale.
    """
    e = solution.estimate
    found = [(n, abs(e.value(n)) / prior_sd[n]) for n in e.names if n in prior_sd and abs(e.value(n)) > limit * prior_sd[n]]
    return sorted(found, key=lambda item: -item[1])


def solve_joint(  # noqa: PLR0913 - every one of them is a choice of the caller, all with a default
    machine: Machine,
    runs: tuple[RunData, ...],
    *,
    order: int | None = None,
    model: Model = "rigid21",
    sigma_mm: dict[str, float] | None = None,
    floor_mm: dict[str, float] | None = None,
    priors: Priors | None = None,
    progress: StageSink | None = None,
) -> JointSolution:
    """Solve all runs of a campaign together.

    Parameters
    ----------
    order : int, optional
        Highest Legendre order of the error motions. Default: chosen by held-out runs, with higher orders up to 12 as nuisance unknowns. If
        given, there are no terms above it, so the uncertainties hold only for a machine of that order.
    model : "rigid6", "rigid21" or "auto"
        rigid6: three scales and three squareness errors; rigid21: 21 error motions; auto: rigid6 unless left-out set-ups and regions
        support rigid21.
    sigma_mm, floor_mm : dict with keys "bar", "laser", optional
        Start values of the estimated noise: standard uncertainty of one raw reading, and least standard uncertainty of an averaged value.
        Default: from repeats, and the resolution.
    progress : callable, optional
        Called with one line of text per stage.

    Raises
    ------
    ValueError
        No runs, or a run that cannot be used (named).
    """
    if not runs:
        raise ValueError("joint solution: no runs")
    report = progress or _silent
    noise = expected_noise(runs, sigma_mm, floor_mm)
    points = all(run.kind == "artefact" for run in runs)
    if points:
        priors = replace(priors or Priors(), pooled=True)
    terms = _six() if model == "rigid6" else smooth_terms(order or SMOOTH_ORDER)
    problem = build(machine, terms, runs, priors or Priors(), noise)
    fit = settle(problem, report)
    if model == "rigid6":
        return _solution(problem, fit, "rigid6", 1, None)
    if order is None and points:
        problem, fit = refined(problem, fit, lambda fine: _again(machine, terms, fine, priors or Priors(), noise, report))
    if order is None and rough_evidence(problem, fit, rough_terms()) > (ROUGH_POINTS if points else ROUGH_EVIDENCE):
        report("the readings show error motions that are rough")
        terms = (*terms, *rough_terms())
        problem, fit = _again(machine, terms, problem.runs, priors or Priors(), noise, report)
    left_out = fit.parts
    if model == "auto":
        left_out = (*left_out, *(sums_of(problem, fit, rows) for rows in regions(problem.runs)))
    choice = choose(total(fit.parts), left_out, fit.components, fit.sizes, term_levels(terms, len(problem.names) - len(terms)))
    if model == "auto" and choice.chosen == RIGID6:
        report("left-out set-ups and regions support only scales and squareness")
        six = build(machine, _six(), runs, priors or Priors(), noise)
        return _solution(six, settle(six, report), "rigid6", 1, choice)
    chosen = order or max(choice.chosen, 1)
    report(f"order {chosen}" + ("" if order else " chosen by held-out runs"))
    return _solution(problem, fit, "rigid21", chosen, None if order else choice)


def settled_points(machine: Machine, runs: tuple[RunData, ...], priors: Priors) -> tuple[CampaignProblem, CampaignFit]:
    """Set up and solve a campaign of artefacts with smooth motions only, for the search for faults."""
    return _again(machine, smooth_terms(SMOOTH_ORDER), runs, replace(priors, pooled=True), expected_noise(runs, None, None), _silent)


def _again(
    machine: Machine, terms: tuple[Term, ...], runs: tuple[RunData, ...], priors: Priors, noise: InstrumentNoise, report: StageSink
) -> tuple[CampaignProblem, CampaignFit]:
    problem = build(machine, terms, runs, priors, noise)
    return problem, settle(problem, report)


def _silent(_: str) -> None:
    return None


def _six() -> tuple[Term, ...]:
    return tuple(t for t in smooth_terms(1) if t.order == 0 or t.component == t.axis)


def _solution(problem: CampaignProblem, fit: CampaignFit, model: str, order: int, choice: OrderChoice | None) -> JointSolution:
    whole, c = total(fit.parts), fit.components
    information = np.tensordot(np.exp(-c.eta), whole.gram, 1) / np.outer(fit.sizes.typical, fit.sizes.typical)
    factor = np.exp(0.5 * c.eta)
    drifts = scale_drifts(problem, fit)
    solution = JointSolution(
        machine=problem.machine,
        terms=problem.terms,
        estimate=_estimate(problem, fit),
        identifiability=_rank(problem, order),
        runs=_fits(problem, fit),
        tool_count=len({tuple(np.round(with_tool(problem.machine, r.tool_mm).tool_mm, 6)) for r in problem.runs}),
        data=problem.runs,
        setup=problem.setup,
        prior_sd=fit.prior_sd,
        information=information,
        prior_root=fit.sizes.typical[:, None] * fit.sizes.root * c.half(fit.sizes),
        weight_per_mm2=(np.exp(-c.eta) / fit.decimation)[problem.readings.kind] * fit.weight / problem.sigma**2,
        order=order,
        noise_mm={k: float(problem.noise.sigma_mm[k] * factor[i]) for i, k in enumerate(KINDS) if whole.count[i] > 0},
        noise_repeats_mm={k: v for i, (k, v) in enumerate(problem.noise.repeats_mm.items()) if whole.count[i] > 0},
        outliers=_outliers(problem, fit),
        residual_tests=residual_tests(problem.runs, problem.split(fit.size), problem.split(fit.weight)),
        model=model,
        order_choice=choice,
        size_factors={n: float(np.exp(0.5 * v)) for n, v in zip(fit.sizes.names, c.psi, strict=True)} | {"length": fit.sizes.length},
        scale_drifts=drifts,
    )
    return widened(solution, "scale_drift", drift_factor(problem, drifts)) if drifts else solution


def _estimate(problem: CampaignProblem, fit: CampaignFit) -> ParameterEstimate:
    """The fit as a `ParameterEstimate`; its variance factor is 1, because the noise itself is estimated."""
    effective = float(len(problem.names) - np.trace(fit.posterior.cov))
    noise = np.exp(0.5 * fit.components.eta)[problem.readings.kind] * problem.sigma
    chi2 = float(fit.weight @ (fit.residual_mm / noise) ** 2)
    share = np.clip(1.0 - fit.covariance.diagonal() / fit.prior_sd**2, 0.0, 1.0)
    dof = max(float(fit.weight.sum()) - effective, 1.0)
    return ParameterEstimate(problem.names, fit.theta, fit.covariance, fit.residual_mm, chi2, dof, 1.0, share)


def _rank(problem: CampaignProblem, order: int) -> Identifiability:
    """Analyse the rank of the terms up to ``order``; higher ones are left out.

    Lost motion is free, too, as are the set-up unknowns that `stated_knowledge` does not count as known. The weights of hidden combinations
    are in units of typical sizes.
    """
    inside = [i for i, t in enumerate(problem.terms) if t.order <= order]
    terms, names = tuple(problem.terms[i] for i in inside), tuple(problem.names[i] for i in inside)
    columns = compressed(campaign_columns(problem.machine, terms, problem.runs, problem.setup))
    known = stated_knowledge(terms, problem.runs, problem.setup.names)
    observed = observed_information(columns, known)
    hidden = combinations_of(names, observed.null_space * (observed.factor / problem.sizes.typical[inside])[:, None])
    involved = taking_part(names, observed.null_space) | hidden_free(columns, known, observed)
    return Identifiability(len(names), observed.rank, observed.effective_rank, observed.condition, hidden, involved)


def _fits(problem: CampaignProblem, fit: CampaignFit) -> tuple[RunFit, ...]:
    noise = np.exp(0.5 * fit.components.eta)[problem.readings.kind] * problem.sigma
    parts = zip(problem.runs, problem.split(fit.residual_mm), problem.split(noise), strict=True)
    return tuple(RunFit(r.label, r.kind, v, float(np.sqrt(np.mean(v**2))), float(np.sqrt(np.mean(s**2)))) for r, v, s in parts)


def _outliers(problem: CampaignProblem, fit: CampaignFit) -> tuple[Outlier, ...]:
    found = []
    for run, size, weight in zip(problem.runs, problem.split(fit.size), problem.split(fit.weight), strict=True):
        found += [Outlier(run.label, int(i), float(size[i]), float(weight[i])) for i in np.flatnonzero(weight < 1.0)]
    return tuple(sorted(found, key=lambda o: -abs(o.size)))
