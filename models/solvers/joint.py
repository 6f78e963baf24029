"""One joint solution of ball-bar and laser runs: 21 error motions, lost motion, and every set-up error as an unknown.

Published methods solve the data sets one by one and take the set-ups as perfect (math.md 4.5, 5.4). Here cup offsets, bar lengths, mirror
tilts, laser zeros and drifts are unknowns with documented priors (`models.solvers.priors`); what the data cannot separate is listed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models.arrays import F1, F2
from models.geometry.bases import DIRECTIONS, Term, smooth_terms
from models.geometry.chain import design
from models.machine import Machine
from models.solvers.identifiability import Identifiability, analyse, project_out
from models.solvers.least_squares import Estimate, solve_map
from models.solvers.observations import RunData
from models.solvers.observe import Setup, predict, run_design, setup_unknowns, with_tool
from models.solvers.priors import Priors, term_prior_sd


@dataclass(frozen=True)
class RunFit:
    """How one run was fitted: residuals in the order of its (averaged) readings, their rms, and the rms that was expected, mm."""

    label: str
    kind: str
    residual_mm: F1
    rms_mm: float
    expected_mm: float


@dataclass(frozen=True)
class JointSolution:
    """Error motions of the machine from all runs together.

    ``estimate`` holds the smooth terms first (in the order of ``terms``), then backlash, then the set-up unknowns. ``tool_count``: how many
    different tools the runs used; with one, what only another tool would show stays hidden (math.md 4.6). ``data``: the runs as they were
    used; ``setup``: their set-up unknowns; ``prior_sd``: prior standard deviation of every unknown of ``estimate``; ``information``: what
    the readings alone say of them (A^T W A, no prior), shape (p, p), in the unknowns' own units.
    """

    machine: Machine
    terms: tuple[Term, ...]
    estimate: Estimate
    identifiability: Identifiability
    runs: tuple[RunFit, ...]
    tool_count: int
    data: tuple[RunData, ...]
    setup: Setup
    prior_sd: F1
    information: F2

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
        """Predicted deviation (without lost motion) at commanded positions, shape (n, 3); ``tool_mm``: another tool than the machine's."""
        return np.asarray(design(with_tool(self.machine, tool_mm), self.terms, axes_mm) @ self.coefficients)

    def backlash_mm(self) -> dict[str, tuple[float, float]]:
        """Lost motion of each axis and its standard uncertainty, mm."""
        return {a: (self.estimate.value(f"backlash_{a}"), self.estimate.u(f"backlash_{a}")) for a in DIRECTIONS}


def implausible(solution: JointSolution, prior_sd: dict[str, float], limit: float = 5.0) -> list[tuple[str, float]]:
    """Set-up unknowns farther from zero than ``limit`` prior standard deviations: (name, how many), largest first.

    A bar length that far off means that ball-bar and laser do not measure in the same millimetres.
    """
    e = solution.estimate
    found = [(n, abs(e.value(n)) / prior_sd[n]) for n in e.names if n in prior_sd and abs(e.value(n)) > limit * prior_sd[n]]
    return sorted(found, key=lambda item: -item[1])


def solve_joint(
    machine: Machine,
    runs: tuple[RunData, ...],
    *,
    order: int,
    sigma_mm: dict[str, float],
    floor_mm: dict[str, float],
    priors: Priors | None = None,
) -> JointSolution:
    """Solve all runs of a campaign together.

    Parameters
    ----------
    order : int
        Highest Legendre order of the error motions.
    sigma_mm, floor_mm : dict with keys "bar", "laser"
        Standard uncertainty of one raw reading; smallest uncertainty of an averaged value (what smooth functions cannot follow).

    Raises
    ------
    ValueError
        No runs, or a run that cannot be used (named).
    """
    if not runs:
        raise ValueError("joint solution: no runs")
    terms, priors = smooth_terms(order), priors or Priors()
    setup = setup_unknowns(runs, priors)
    names, prior = _unknowns(machine, terms, setup, priors)
    a = np.concatenate([run_design(machine, terms, run, setup) for run in runs])
    sigma = np.concatenate([np.hypot(sigma_mm[r.kind] / np.sqrt(r.weight_n), floor_mm[r.kind]) for r in runs])
    y = np.concatenate([r.deviation_mm for r in runs])

    def reading(theta: F1) -> F1:
        return np.concatenate([predict(machine, terms, r, setup, theta) for r in runs])

    estimate = solve_map(names, a, y - reading(np.zeros(len(names))), sigma, prior)
    for _ in range(2):  # the ball-bar is slightly non-linear: 0.01 um at 60 um of offset
        estimate = solve_map(names, a, y - reading(estimate.theta) + a @ estimate.theta, sigma, prior)
    rank = _rank(names[: len(terms)], a / sigma[:, None], prior[: len(terms)])
    whitened = a / sigma[:, None]
    fits = _fits(runs, y - reading(estimate.theta), sigma)
    return JointSolution(machine, terms, estimate, rank, fits, _tools(machine, runs), runs, setup, prior, whitened.T @ whitened)


def _unknowns(machine: Machine, terms: tuple[Term, ...], setup: Setup, priors: Priors) -> tuple[tuple[str, ...], F1]:
    names = tuple(t.name for t in terms) + tuple(f"backlash_{a}" for a in DIRECTIONS) + setup.names
    return names, np.concatenate([term_prior_sd(machine, terms, priors), np.full(3, priors.backlash_mm), setup.prior_sd])


def _rank(names: tuple[str, ...], whitened: F2, typical: F1) -> Identifiability:
    """What the runs see of the first ``len(names)`` unknowns when all others are free."""
    n = len(names)
    return analyse(names, project_out(whitened[:, :n], whitened[:, n:]), typical)


def _tools(machine: Machine, runs: tuple[RunData, ...]) -> int:
    return len({tuple(np.round(with_tool(machine, r.tool_mm).tool_mm, 6)) for r in runs})


def _fits(runs: tuple[RunData, ...], residual: F1, sigma: F1) -> tuple[RunFit, ...]:
    ends = np.cumsum([r.deviation_mm.size for r in runs])[:-1]
    parts = zip(runs, np.split(residual, ends), np.split(sigma, ends), strict=True)
    return tuple(RunFit(r.label, r.kind, v, float(np.sqrt(np.mean(v**2))), float(np.sqrt(np.mean(s**2)))) for r, v, s in parts)
