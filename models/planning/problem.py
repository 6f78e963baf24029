"""Information of one mounting, as a matrix over the unknowns that all mountings share.

The mountings share the smooth terms, the lost motion, the bars' lengths and temperature and the laser's wavelength. Cup, mirror tilts, zero
and drift belong to one mounting and are marginalised (Schur complement with their priors). The shared unknowns are expressed by independent
ones of prior variance 1 (`PlanningProblem.root`), so the prior's information is the unit matrix.

Poses of an artefact of unknown form share that form, so all poses are evaluated together (`pose_uncertainty_mm`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from abbe.models.arrays import F1, F2
from abbe.models.geometry.bases import DIRECTIONS, Term, smooth_terms
from abbe.models.geometry.chain import design
from abbe.models.geometry.volume import rigid_design, volume_grid
from abbe.models.machine import AXES, Machine
from abbe.models.planning.measurements import BAR_VALUES, HelixTest, Instruments, Measurement, expected_run
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe import LOST, bar_length_name, run_design, setup_unknowns
from abbe.models.solvers.priors import Priors, size_model

LASER_SCALE = "laser_scale"
BAR_SCALE = "bar_temperature"
PAUSE_S = 60.0
"""Pause between two runs of one mounting; drifts continue in it."""
SEARCH_VALUES = 120
"""Points that replace a helix's block means during the search, at the same total weight: 24 per turn resolve every smooth term."""


@dataclass(frozen=True)
class PlanningProblem:
    """Machine, instruments and priors of a plan, and the unknowns that all mountings share.

    ``root``, shape (size, size): factor of their prior covariance; unknowns (mm, rad) = ``root`` @ independent unknowns of variance 1. A
    solution starts from the same prior (`abbe.models.solvers.priors.size_model`).
    """

    machine: Machine
    tools: Instruments
    priors: Priors
    terms: tuple[Term, ...]
    names: tuple[str, ...]
    root: F2

    @property
    def size(self) -> int:
        """Number of shared unknowns."""
        return len(self.names)


def problem(machine: Machine, tools: Instruments, order: int, priors: Priors | None = None) -> PlanningProblem:
    """Set up the planning problem; ``order``: highest Legendre order of the error motions."""
    priors, terms = priors or Priors(), smooth_terms(order)
    bars = [bar_length_name(r) for r in sorted(tools.bar_lengths_mm)]
    names = (*(t.name for t in terms), *(f"backlash_{a}" for a in DIRECTIONS), *bars, LASER_SCALE, BAR_SCALE)
    rest = [priors.backlash_mm] * 3 + [tools.u_bar_length_mm] * len(bars) + [tools.u_wavelength]
    rest.append(tools.inputs.u_bar_temperature_k * tools.inputs.bar_expansion_per_k)
    sizes = size_model(machine, terms, names[len(terms) :], np.array(rest), priors)
    return PlanningProblem(machine, tools, priors, terms, names, sizes.typical[:, None] * sizes.root)


def mounting_information(what: PlanningProblem, tests: tuple[Measurement, ...]) -> F2:
    """Information of all tests of one mounting about the shared unknowns in the units of ``root``, shape (size, size)."""
    runs = _search_runs(what, tests)
    setup = setup_unknowns(runs, what.priors)
    own = [i for i, n in enumerate(setup.names) if n not in what.names]
    shared, nuisance = [], []
    for run in runs:
        full = run_design(what.machine, what.terms, run, setup) / _sigma(what, run)[:, None]
        shared.append(_shared_columns(what, run, full, setup.names))
        nuisance.append(full[:, len(what.terms) + 3 :][:, own] * setup.prior_sd[own])
    a, b = np.concatenate(shared), np.concatenate(nuisance)
    cross = b.T @ a
    return np.asarray(a.T @ a - cross.T @ scipy.linalg.solve(b.T @ b + np.eye(len(own)), cross, assume_a="pos"))


def _search_runs(what: PlanningProblem, tests: tuple[Measurement, ...]) -> tuple[RunData, ...]:
    """The runs of one mounting, one after the other in time, because drifts continue from run to run."""
    runs: list[RunData] = []
    for test in tests:
        start_s = float(runs[-1].t_s[-1]) + PAUSE_S if runs else 0.0
        values = SEARCH_VALUES if isinstance(test, HelixTest) else BAR_VALUES
        runs.append(expected_run(what.machine, test, what.tools, values=values, start_s=start_s))
    return tuple(runs)


def _sigma(what: PlanningProblem, run: RunData) -> F1:
    """Standard uncertainty of each value, scaled so that few planned points contain as much information as the real block means."""
    tools = what.tools
    if run.kind == "laser":
        return np.hypot(tools.laser_noise_mm / np.sqrt(run.weight_n), tools.floor_mm)
    n, raw = run.deviation_mm.size, run.weight_n.sum()
    values = min(BAR_VALUES, raw)
    return np.full(n, np.hypot(tools.bar_noise_mm / np.sqrt(raw / values), tools.floor_mm) * np.sqrt(n / values))


def _shared_columns(what: PlanningProblem, run: RunData, full: F2, setup_names: tuple[str, ...]) -> F2:
    first = len(what.terms) + 3
    out = np.zeros((full.shape[0], what.size))
    out[:, :first] = full[:, :first]
    for i, name in enumerate(setup_names):
        if name in what.names:
            out[:, what.names.index(name)] = full[:, first + i]
    if run.radius_mm is not None:  # a bar that is warmer than assumed is longer in proportion to its length
        out[:, what.names.index(BAR_SCALE)] = full[:, first + setup_names.index(bar_length_name(run.radius_mm))] * run.radius_mm
    return np.asarray(out @ what.root)


def factor(information: F2) -> F2:
    """Rows F with F^T F = information, without directions of less than 1e-5 of the prior's information, shape (r, size)."""
    value, vector = scipy.linalg.eigh(information, driver="evd")  # faster than a driver that finds only the needed eigenvalues
    kept = value > 1e-5
    return np.asarray(np.sqrt(value[kept])[:, None] * vector.T[kept])


def field_rows(what: PlanningProblem, share: float, nodes: int) -> F2:
    """Deviation, rigid motion removed, at nodes of the inner volume per unit of ``root``, shape (nodes^3 * 3, size), mm."""
    box = what.machine.centre_mm[:, None] + share * (what.machine.stroke_mm - what.machine.centre_mm[:, None])
    grid = volume_grid(box, nodes)
    g = design(what.machine, what.terms, grid).reshape(-1, len(what.terms))
    rigid, _ = np.linalg.qr(rigid_design(grid).reshape(-1, 6))
    out = np.zeros((g.shape[0], what.size))
    out[:, : len(what.terms)] = g - rigid @ (rigid.T @ g)
    return np.asarray(out @ what.root)


def scale_temperature_mm2(what: PlanningProblem, rows: F2) -> F1:
    """Variance from the scales' unknown temperature at each node of ``rows`` (`field_rows`), rigid motion removed, shape (nodes^3,), mm^2.

    As in the budget of a solution (`abbe.models.uncertainty.sources`), each axis is independently too long by expansion times temperature.
    No reading shows this error, because it concerns the days after the campaign.
    """
    slope = what.tools.inputs.u_scale_temperature_k * what.tools.inputs.scale_expansion_per_k
    out = np.zeros(rows.shape[0])
    for a, axis in enumerate(AXES):
        i = what.names.index(f"E{axis}{axis}.1")
        out += (rows[:, i] / what.root[i, i] * slope * what.machine.length_mm[a] / 2.0) ** 2
    return np.asarray(out.reshape(-1, 3).sum(axis=1))


def uncertainty_mm(information: F2, rows: F2, stated_mm2: F1 | float = 0.0) -> tuple[float, float]:
    """Standard uncertainty of the deviation vector at the worst node and as root mean square over the nodes, mm.

    ``stated_mm2``: further variance at each node, which readings do not reduce (`scale_temperature_mm2`).
    """
    half = scipy.linalg.solve_triangular(scipy.linalg.cholesky(information, lower=True), rows.T, lower=True)
    v = (half**2).sum(axis=0).reshape(-1, 3).sum(axis=1) + stated_mm2
    return float(np.sqrt(v.max())), float(np.sqrt(v.mean()))


def pose_fields(what: PlanningProblem, points_mm: F2, n_axes: int) -> F2:
    """Deviation at points per unit of ``root``, the best-fit rigid motion removed, shape (n_axes * points, size), mm.

    ``n_axes``: 2, X and Y at points in a plane; 3, all axes.
    """
    fields = design(what.machine, what.terms, points_mm)[:, :n_axes].reshape(n_axes * len(points_mm), -1)
    return np.asarray(_without_motion(points_mm, fields, n_axes) @ what.root[: len(what.terms)])


def pose_uncertainty_mm(what: PlanningProblem, runs: tuple[RunData, ...], fields: F2, noise_mm: float, n_axes: int) -> tuple[float, float]:
    """Return the standard uncertainty of the deviation at the points of ``fields`` (`pose_fields`): at the worst point, and rms, mm.

    ``runs``: poses, and calibrated lengths of the artefact; ``noise_mm``: per reading.
    """
    n_terms = len(what.terms)
    setup = setup_unknowns(runs, what.priors, what.machine)
    full = np.concatenate([run_design(what.machine, what.terms, r, setup) * np.sqrt(r.weight_n)[:, None] for r in runs]) / noise_mm
    shared = full[:, : n_terms + LOST] @ what.root[: n_terms + LOST]
    a = np.concatenate([shared, full[:, n_terms + LOST :] * setup.prior_sd], axis=1)
    low = scipy.linalg.cholesky(a.T @ a + np.eye(a.shape[1]), lower=True)
    whole = np.concatenate([fields.T, np.zeros((a.shape[1] - fields.shape[1], len(fields)))])
    half = scipy.linalg.solve_triangular(low, whole, lower=True)
    variance = (half**2).sum(axis=0).reshape(-1, n_axes).sum(axis=1)
    return float(np.sqrt(variance.max())), float(np.sqrt(variance.mean()))


def _without_motion(points_mm: F2, rows: F2, n_axes: int) -> F2:
    motion = rigid_design(points_mm)[:, :n_axes]
    basis, _ = np.linalg.qr((motion if n_axes == 3 else motion[:, :, [0, 1, 5]]).reshape(n_axes * len(points_mm), -1))
    return np.asarray(rows - basis @ (basis.T @ rows))
