"""Report of what a campaign determines about a machine and what it leaves open, before the measurement or after the solution.

`observability` needs only the runs' set-ups and positions, for planning; `observability_of` takes a solution. Both give the rank, hidden
combinations as text with cause and cure, the status of every parameter and motion, and the uncertainty of the deviation in the volume. The
rank comes from readings and stated calibrations alone; uncertainties include the documented priors (`abbe.models.solvers.priors`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from abbe.models.arrays import F1, F2
from abbe.models.geometry.bases import DIRECTIONS, Term, smooth_terms
from abbe.models.geometry.volume import unit_deviation, volume_frame, volume_grid
from abbe.models.machine import Machine
from abbe.models.solvers.joint import JointSolution
from abbe.models.solvers.observability.cures import CampaignLayout
from abbe.models.solvers.observability.hidden import Advice, HiddenGroup, picture
from abbe.models.solvers.observability.rank import (
    CampaignColumns,
    Correlation,
    Knowledge,
    MotionStatus,
    ObservedInformation,
    ParameterStatus,
    campaign_columns,
    compressed,
    correlations,
    hidden_free,
    hidden_terms,
    motions,
    observed_information,
    parameters,
    stated_knowledge,
)
from abbe.models.solvers.observability.volume import Knowing, Number, Plane, Volume, observability_number, plane_at, volume_at, whole_volume
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe import setup_unknowns
from abbe.models.solvers.priors import Priors, size_model, term_prior_sd

__all__ = ["MapAgainstPrior", "Observability", "map_against_prior", "motions_of", "observability", "observability_of"]

SIGMA_MM = {"bar": 0.5e-3, "laser": 0.3e-3}
FLOOR_MM = {"bar": 0.5e-3, "laser": 0.3e-3}
"""Default noise of one reading and least uncertainty of an averaged reading, mm, for a campaign that is only planned."""


@dataclass(frozen=True)
class Observability:
    """The whole report of a campaign's observability.

    Attributes
    ----------
    machine, terms, model
        Nominal machine; coefficients of its error motions that count for the rank; all coefficients of the model (a solution also has
        higher orders, so that its uncertainties are not too small).
    observed : ObservedInformation
        Rank, effective rank, condition, null space (unit columns).
    reachable : int
        Largest rank that runs with the same tools could have, if they measured the whole deviation vector everywhere.
    known : tuple of str
        Set-up unknowns that count as known for the rank, because a run or the caller states them.
    hidden : tuple of HiddenGroup
        The null space in words; combinations that do not move any of the tools used come last.
    advice : tuple of Advice
        Additions to the campaign, each the most useful after the previous ones, with the rank after each.
    parameters, correlations, motions
        Every unknown; pairs with a correlation above 0.9; every error motion as a function.
    knowing : Knowing
        Covariances of the coefficients of ``model``.
    volume : Volume
        Figures on a grid of 11 nodes per axis; for other points see `at`.
    number : Number
        The observability number.
    """

    machine: Machine
    terms: tuple[Term, ...]
    model: tuple[Term, ...]
    observed: ObservedInformation
    reachable: int
    known: tuple[str, ...]
    hidden: tuple[HiddenGroup, ...]
    advice: tuple[Advice, ...]
    parameters: tuple[ParameterStatus, ...]
    correlations: tuple[Correlation, ...]
    motions: tuple[MotionStatus, ...]
    knowing: Knowing
    volume: Volume
    number: Number

    @property
    def rank(self) -> int:
        """Number of combinations of coefficients that the readings determine."""
        return self.observed.rank

    def at(self, axes_mm: F2) -> Volume:
        """Prior size, uncertainty and noise gain at commanded positions (n, 3), mm."""
        return volume_at(self.machine, self.model, self.knowing, axes_mm)

    def plane(self, fixed: int = 2, nodes: int = 15) -> Plane:
        """Do the same as `at` on nodes x nodes points of the plane through the middle of axis ``fixed`` (0 X, 1 Y, 2 Z), for a picture."""
        return plane_at(self.machine, self.model, self.knowing, fixed, nodes)

    def lines(self) -> tuple[str, ...]:
        """The report in short sentences, most important first."""
        n, v, k = len(self.terms), self.volume, self.volume.worst_point
        out = [self.number.text]
        out.append(f"The readings show {self.observed.rank} of {n} coefficients, {self.observed.effective_rank} of them well; ")
        out[-1] += f"with the tools used no run could show more than {self.reachable}."
        place = ", ".join(f"{x:.0f}" for x in v.axes_mm[k])
        out.append(
            f"Largest standard uncertainty of the predicted deviation: {v.u_mm[k] * 1e3:.2g} µm at ({place}) mm; noise gain there "
            f"{v.gain[k]:.2g} µm per µm."
        )
        out += [g.text for g in self.hidden]
        return (*out, *(a.text for a in self.advice))


def observability(
    machine: Machine,
    runs: tuple[RunData, ...],
    *,
    terms: int | tuple[Term, ...] = 5,
    priors: Priors | None = None,
    sigma_mm: dict[str, float] | None = None,
    floor_mm: dict[str, float] | None = None,
    known: Knowledge | None = None,
) -> Observability:
    """Report what runs can determine, from their positions only; readings are not used.

    Parameters
    ----------
    terms : int or tuple of Term
        The model: highest Legendre order of the 21 error motions, or its coefficients.
    priors : Priors, optional
        As in `abbe.models.solvers.joint.solve_joint`.
    sigma_mm, floor_mm : dict with keys "bar", "laser", optional
        Standard uncertainty of one raw reading, and least standard uncertainty of an averaged value, mm.
    known : Knowledge, optional
        Knowledge of the set-up for the rank; default `stated_knowledge`: what the runs themselves state.

    Raises
    ------
    ValueError
        No runs, or runs that contradict each other (`setup_unknowns`).
    """
    if not runs:
        raise ValueError("observability: no runs")
    terms = smooth_terms(terms) if isinstance(terms, int) else terms
    priors = priors or Priors()
    setup = setup_unknowns(runs, priors, machine)
    sigma, floor = sigma_mm or SIGMA_MM, floor_mm or FLOOR_MM
    rest = tuple(f"backlash_{a}" for a in DIRECTIONS) + setup.names
    sizes = size_model(machine, terms, rest, np.concatenate([np.full(3, priors.backlash_mm), setup.prior_sd]), priors)
    u = np.concatenate([np.maximum(sigma[r.kind] / np.sqrt(r.weight_n), floor[r.kind]) for r in runs])
    columns = campaign_columns(machine, terms, runs, setup)
    whitened = np.concatenate([columns.machine, columns.lost, columns.setup], axis=1) / u[:, None]
    information, root = whitened.T @ whitened, sizes.typical[:, None] * sizes.root
    beliefs = _Beliefs(None, posterior_covariance(information, root), root, information, float(np.sqrt(np.mean(u**2))))
    return _report(_Model(machine, terms, len(terms)), runs, columns, beliefs, known)


def observability_of(solution: JointSolution, known: Knowledge | None = None) -> Observability:
    """Report what the runs of a solution determined, as `observability` does, with the solution's estimates, covariance, priors and noise.

    Rank and null space count the terms up to the solution's chosen order; uncertainties and shares include its higher orders too.
    """
    e, s = solution.estimate, solution
    noise = np.concatenate([np.full(r.residual_mm.size, r.expected_mm) for r in s.runs])
    beliefs = _Beliefs(e.theta, e.covariance, s.prior_root, s.information, float(np.sqrt(np.mean(noise**2))))
    columns = campaign_columns(s.machine, s.terms, s.data, s.setup)
    return _report(_Model(s.machine, s.terms, s.order), s.data, columns, beliefs, known)


LARGEST_MAP = 3.0
"""Largest rms of a predicted map, as a multiple of the rms of a usual machine's errors."""
MOST_READ = 2.0
"""Largest excess of a map's rms over the rms of a usual machine's errors, as a multiple of the largest rms of a run. One of 500 campaigns
of one to five runs exceeded this limit: a single step diagonal on a rough machine, whose map was 6 times as large as the machine's errors.
"""
WELL_KNOWN = 0.2
"""Relative uncertainty below which a map may be larger than what was measured: a small circle shows the squareness of a large machine."""
MAP_NODES = 5


@dataclass(frozen=True)
class MapAgainstPrior:
    """Rms lengths over the volume, mm: of a solution's map, of its standard uncertainty, and of a usual machine's errors by the priors.

    ``measured_mm``: largest rms of the deviations of one run.
    """

    predicted_mm: float
    u_mm: float
    prior_mm: float
    measured_mm: float

    @property
    def carried(self) -> bool:
        """Whether readings support the map: its uncertainty is at most the priors' rms, its rms at most `LARGEST_MAP` times the priors'
        rms, and the runs measured enough for it (`read`).
        """
        return self.u_mm <= self.prior_mm and self.predicted_mm <= LARGEST_MAP * self.prior_mm and self.read

    @property
    def read(self) -> bool:
        """Whether the runs measured enough for the map.

        This holds if its rms exceeds the priors' rms by at most `MOST_READ` times ``measured_mm``, or if its relative uncertainty is at
        most `WELL_KNOWN`.
        """
        return self.predicted_mm <= self.prior_mm + MOST_READ * self.measured_mm or self.u_mm <= WELL_KNOWN * self.predicted_mm


def map_against_prior(solution: JointSolution) -> MapAgainstPrior:
    """Compare a solution's map, best-fit rigid motion removed, with the documented priors on an even grid over the strokes."""
    machine, terms = solution.machine, solution.terms
    grid = volume_grid(machine.stroke_mm, MAP_NODES)
    unit = unit_deviation(machine, terms, grid, None, volume_frame(machine, MAP_NODES))
    sd = term_prior_sd(machine, terms, Priors())
    u2 = np.einsum("mcp,pq,mcq->m", unit, solution.term_covariance, unit, optimize=True)
    return MapAgainstPrior(
        float(np.sqrt(np.mean(np.sum((unit @ solution.coefficients) ** 2, axis=1)))),
        float(np.sqrt(np.maximum(u2, 0.0).mean())),
        float(np.sqrt(np.mean(np.sum((unit * sd) ** 2, axis=(1, 2))))),
        max(float(np.sqrt(np.mean(run.deviation_mm**2))) for run in solution.data),
    )


def motions_of(solution: JointSolution) -> tuple[MotionStatus, ...]:
    """Status of every error motion of a solution, as in the whole report, without computation of the other parts."""
    p = len(solution.terms)
    root = solution.prior_root[:p]
    return motions(solution.machine, solution.terms, solution.term_covariance, root @ root.T, solution.identifiability.involved)


def posterior_covariance(information: F2, prior_root: F2) -> F2:
    """Covariance of all unknowns, shape (p, p), from the information of the readings and the prior covariance root root^T."""
    scaled = prior_root.T @ information @ prior_root + np.eye(information.shape[0])
    low = scipy.linalg.cholesky(scaled, lower=True, check_finite=False)
    half = scipy.linalg.solve_triangular(low, prior_root.T, lower=True, check_finite=False)
    return np.asarray(half.T @ half)


@dataclass(frozen=True)
class _Beliefs:
    """Estimates (None before solving), covariance, root of the prior covariance, information of the readings, rms reading noise, mm."""

    theta: F1 | None
    covariance: F2
    prior_root: F2
    information: F2
    noise_mm: float


@dataclass(frozen=True)
class _Model:
    """Nominal machine, its terms, and the highest order that counts for the rank."""

    machine: Machine
    terms: tuple[Term, ...]
    order: int


def _report(
    model: _Model, runs: tuple[RunData, ...], columns: CampaignColumns, beliefs: _Beliefs, known: Knowledge | None
) -> Observability:
    machine, p = model.machine, len(model.terms)
    counted = [i for i, t in enumerate(model.terms) if t.order <= model.order]
    terms = tuple(model.terms[i] for i in counted)
    few = compressed(replace(columns, machine=columns.machine[:, counted]))
    known = stated_knowledge(terms, runs, columns.setup_names) if known is None else known
    observed, prior_sd = observed_information(few, known), np.linalg.norm(beliefs.prior_root, axis=1)
    found = picture(CampaignLayout(machine, terms, runs, few, known), observed, prior_sd[counted])
    names = (*(t.name for t in model.terms), *(f"backlash_{a}" for a in DIRECTIONS), *columns.setup_names)
    secret = hidden_terms(terms, observed.null_space)
    knowing = _knowing(beliefs, p)
    volume = whole_volume(machine, model.terms, knowing)
    return Observability(
        machine=machine,
        terms=terms,
        model=model.terms,
        observed=observed,
        reachable=found.reachable,
        known=tuple(known.fixed),
        hidden=found.groups,
        advice=found.advice,
        parameters=parameters(names, beliefs.theta, beliefs.covariance, prior_sd, secret | hidden_free(few, known, observed)),
        correlations=correlations(names, beliefs.covariance),
        motions=motions(machine, model.terms, knowing.posterior, knowing.prior, secret),
        knowing=knowing,
        volume=volume,
        number=observability_number(volume),
    )


def _knowing(beliefs: _Beliefs, p: int) -> Knowing:
    """Covariances of the terms; the noise part belongs to the estimator with its priors."""
    plain = posterior_covariance(beliefs.information, beliefs.prior_root)[:p]
    root = beliefs.prior_root[:p]
    return Knowing(root @ root.T, beliefs.covariance[:p, :p], plain @ beliefs.information @ plain.T / beliefs.noise_mm**2)
