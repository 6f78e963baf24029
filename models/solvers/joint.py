"""One joint solution of ball-bar and laser runs: 21 error motions, lost motion, and every set-up error as an unknown.

Published methods solve the data sets one by one and take the set-ups as perfect (math.md 4.5, 5.4). Here cup offsets, bar lengths, mirror
tilts, laser zeros and drifts are unknowns with documented priors (`models.solvers.priors`); what the data cannot separate is listed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from models.arrays import F1, F2, F3
from models.geometry.bases import DIRECTIONS, Term, smooth_terms
from models.geometry.chain import design
from models.machine import Machine
from models.solvers.identifiability import Identifiability, analyse, project_out
from models.solvers.least_squares import Estimate, solve_map
from models.solvers.observations import RunData
from models.solvers.priors import Priors, bar_length_sd, term_prior_sd


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
    different tools the runs used; with one, what only another tool would show stays hidden (math.md 4.6).
    """

    machine: Machine
    terms: tuple[Term, ...]
    estimate: Estimate
    identifiability: Identifiability
    runs: tuple[RunFit, ...]
    tool_count: int = 1

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


def with_tool(machine: Machine, tool_mm: F1 | None) -> Machine:
    """The machine with another tool, for rule G's levers; None: its own."""
    return machine if tool_mm is None else replace(machine, tool_mm=tool_mm)


def implausible(solution: JointSolution, prior_sd: dict[str, float], limit: float = 5.0) -> list[tuple[str, float]]:
    """Set-up unknowns farther from zero than ``limit`` prior standard deviations: (name, how many), largest first.

    A bar length that far off means that ball-bar and laser do not measure in the same millimetres.
    """
    e = solution.estimate
    found = [(n, abs(e.value(n)) / prior_sd[n]) for n in e.names if n in prior_sd and abs(e.value(n)) > limit * prior_sd[n]]
    return sorted(found, key=lambda item: -item[1])


@dataclass(frozen=True)
class Setup:
    """Names and priors of the set-up unknowns of a campaign."""

    names: tuple[str, ...]
    prior_sd: F1


def setup_unknowns(runs: tuple[RunData, ...], priors: Priors) -> Setup:
    """Set-up unknowns of a set of runs: per cup, per bar length, per mirror, per laser run.

    Runs with the same nominal radius share one bar; where they state its length differently, the widest statement is believed.
    """
    sd: dict[str, float] = {}
    for run in runs:
        if run.kind == "bar":
            sd |= {f"cup_{run.setup}_{a}": priors.cup_mm for a in "xyz"}
            bar = f"bar_length_{run.radius_mm:g}"
            sd[bar] = max(sd.get(bar, 0.0), bar_length_sd(run.u_length_mm, run.length_calibrated, priors))
        else:
            if _bent(run):
                sd |= {f"tilt_{run.setup}_{k}": priors.tilt_rad for k in "12"}
            sd[f"zero_{run.label}"] = priors.zero_mm
            sd[f"drift_{run.label}"] = priors.drift_mm_s
    return Setup(tuple(sd), np.array(list(sd.values())))


def perpendicular(beam: F1) -> F2:
    """Two unit vectors perpendicular to a beam and to each other, shape (2, 3)."""
    helper = np.eye(3)[int(np.argmin(np.abs(beam)))]
    first = np.cross(beam, helper)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(beam, first)])


def _bent(run: RunData) -> bool:
    """Whether the path leaves the beam, so that a tilted mirror shows."""
    assert run.beam is not None
    d = run.axes_mm - run.axes_mm[0]
    return bool(np.abs(d - np.outer(d @ run.beam, run.beam)).max() > 1e-6)


def bar_normals(run: RunData) -> F2:
    """Unit vectors from the nominal cup to the commanded positions, shape (n, 3)."""
    assert run.centre_mm is not None
    d = run.axes_mm - run.centre_mm
    return np.asarray(d / np.linalg.norm(d, axis=1, keepdims=True))


def run_field(machine: Machine, terms: tuple[Term, ...], run: RunData) -> F3:
    """Design of the deviation along a run, with the run's own tool, shape (n, 3, terms)."""
    return design(with_tool(machine, run.tool_mm), terms, run.axes_mm)


def run_design(machine: Machine, terms: tuple[Term, ...], run: RunData, setup: Setup) -> F2:
    """Linearised reading per unit of every unknown of the campaign, shape (n, terms + 3 + set-up)."""
    field = run_field(machine, terms, run)
    lost = -0.5 * run.sign
    out = np.zeros((run.deviation_mm.size, len(setup.names)))
    at = {name: i for i, name in enumerate(setup.names)}
    if run.kind == "bar":
        n = bar_normals(run)
        for k, a in enumerate("xyz"):
            out[:, at[f"cup_{run.setup}_{a}"]] = -n[:, k]
        out[:, at[f"bar_length_{run.radius_mm:g}"]] = 1.0
        return np.concatenate([np.einsum("ni,nik->nk", n, field), n * lost, out], axis=1)
    assert run.beam is not None
    d = run.axes_mm - run.axes_mm[0]
    if _bent(run):
        for k, t in enumerate(perpendicular(run.beam)):
            out[:, at[f"tilt_{run.setup}_{k + 1}"]] = d @ t
    out[:, at[f"zero_{run.label}"]] = 1.0
    out[:, at[f"drift_{run.label}"]] = run.t_s - run.t_s[0]
    seen = np.einsum("i,nik->nk", run.beam, field - field[0])
    return np.concatenate([seen, (lost - lost[0]) * run.beam, out], axis=1)


def predict(machine: Machine, terms: tuple[Term, ...], run: RunData, setup: Setup, theta: F1) -> F1:
    """Reading of a run for given unknowns; the ball-bar without linearisation, shape (n,)."""
    if run.kind == "laser":
        return np.asarray(run_design(machine, terms, run, setup) @ theta)
    assert run.centre_mm is not None
    assert run.radius_mm is not None
    at = {name: i for i, name in enumerate(setup.names)}
    n_terms = len(terms)
    tip = run.axes_mm - run.centre_mm + run_field(machine, terms, run) @ theta[:n_terms]
    tip = tip - 0.5 * run.sign * theta[n_terms : n_terms + 3]
    rest = theta[n_terms + 3 :]
    tip = tip - np.array([rest[at[f"cup_{run.setup}_{a}"]] for a in "xyz"])
    return np.asarray(np.linalg.norm(tip, axis=1) - run.radius_mm + rest[at[f"bar_length_{run.radius_mm:g}"]])


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
    return JointSolution(machine, terms, estimate, rank, _fits(runs, y - reading(estimate.theta), sigma), _tools(machine, runs))


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
