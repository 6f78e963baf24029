"""Uncertainty from a table that was in force during a campaign and is not available.

Smooth corrections of such a table need no knowledge: they belong to the machine as it was measured. Its effect beyond them is bounded: an
axis loses at most its lost motion of each move that the table makes, and straight lines between the table's points differ little from a
smooth curve. So tables of usual machines are drawn, each leaves a pattern in the readings, and their effect on the solution widens the
covariance of all unknowns.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.compensation.tables import NineTables, grid_positions, table_design
from abbe.models.geometry.bases import smooth_terms
from abbe.models.solvers.applied_tables import AppliedTables
from abbe.models.solvers.joint import JointSolution
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.priors import Priors, term_prior_sd
from abbe.models.uncertainty.sources import response
from abbe.service.identification.table_removal import RemovedTable, removed_table

TABLES = 16
"""Number of drawn tables; their effect has about this many degrees of freedom."""
ORDER, NODES, SPACING_MM, UNIT_MM, SEED = 6, 5, 25.0, 1e-4, 16
"""Of the drawn tables: highest Legendre order of the errors that they correct, nodes per axis of their fit, distance of their points, unit
of their entries."""


def with_unknown_table(solution: JointSolution) -> JointSolution:
    """Return the same solution; its covariance includes an unknown table in force (`JointSolution.table_factor`)."""
    r = response(solution)
    effect = r.design.T @ (r.weight[:, None] * reading_patterns_mm(solution))
    factor = r.covariance @ effect / np.sqrt(TABLES)
    left = np.maximum(solution.prior_sd**2 - solution.estimate.covariance.diagonal(), 0.0)
    size = np.sum(factor**2, axis=1)
    factor *= np.sqrt(np.divide(left, size, out=np.ones_like(size), where=size > left))[:, None]  # no unknown is less sure than its prior
    wider = replace(solution.estimate, covariance=solution.estimate.covariance + factor @ factor.T)
    return replace(solution, estimate=wider, table_factor=factor)


def reading_patterns_mm(solution: JointSolution) -> F2:
    """Return the effect of each drawn table on the readings beyond smooth corrections, mm, shape (readings, TABLES)."""
    rng = np.random.default_rng(SEED)
    machine, terms = solution.machine, smooth_terms(ORDER)
    x, y, z = (max(2, round(length / SPACING_MM)) for length in machine.length_mm)
    grids = grid_positions(machine, (x, y, z))
    per_unit = table_design(solution, grids, NODES, terms)
    sd = term_prior_sd(machine, terms, Priors())
    lost, u_lost = np.array(list(solution.backlash_mm().values())).T
    patterns = []
    for _ in range(TABLES):
        drawn = sd * rng.standard_normal(sd.size)
        cx, cy, cz = (np.round(-(one @ drawn) / UNIT_MM) * UNIT_MM for one in per_unit)
        table = NineTables(grids, (cx, cy, cz), (np.zeros_like(cx), np.zeros_like(cy), np.zeros_like(cz)))
        patterns.append(effect_mm(solution.data, removed_table(table, np.abs(lost + u_lost * rng.standard_normal(3)))))
    return np.stack(patterns, axis=1)


def effect_mm(data: tuple[RunData, ...], out: RemovedTable) -> F1:
    """Return the effect of a table on the readings beyond smooth corrections, mm, run by run, shape (readings,)."""
    return np.concatenate([_on_run_mm(run, out.force) - _on_run_mm(run, out.stays) for run in data])


def _on_run_mm(run: RunData, tables: AppliedTables) -> F1:
    if run.centre_mm is not None:
        return tables.bar_mm(run.axes_mm, run.centre_mm)
    if run.beam is None:
        return np.zeros(run.deviation_mm.size)
    return tables.laser_mm(run.axes_mm, run.beam)
