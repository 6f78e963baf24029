"""The best nine tables of an identified machine, fitted over the volume, and the error that remains with them, from all sources."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.compensation.additive import additive_design
from abbe.models.compensation.tables import NineTables, Predicted, grid_positions
from abbe.models.geometry.bases import Term
from abbe.models.geometry.chain import design
from abbe.models.geometry.volume import RigidFree, remove_rigid, rigid_design, volume_grid
from abbe.models.machine import Machine
from abbe.models.solvers.joint import JointSolution
from abbe.models.uncertainty.prediction import budget_over, predict_deviation
from abbe.models.uncertainty.sources import ErrorSources, error_sources, variances


def nine_tables(
    solution: JointSolution, counts: tuple[int, int, int], *, nodes: int = 9, sources: ErrorSources | None = None
) -> NineTables:
    """Make the best nine tables for the identified machine, zero at the first grid position of each axis.

    Parameters
    ----------
    counts : (int, int, int)
        Grid points of X, Y, Z.
    nodes : int
        Nodes per axis of the volume over which the tables are fitted.
    sources : ErrorSources, optional
        Sources of uncertainty; default: ``error_sources(solution)``, with the documented inputs.
    """
    machine, sources = solution.machine, sources or error_sources(solution)
    grids = grid_positions(machine, counts)
    corrections, uncertainties = [], []
    rotation = frame_rotation(machine, sources.terms, nodes)
    for a, relative in enumerate(table_design(solution, grids, nodes, sources.terms)):
        corrections.append(-(relative @ sources.coefficients))
        turned = np.cross(rotation.T, np.eye(3)[a]).T  # slope of the corrections over axis a by a rotation of the frame
        fixed = relative - (grids[a] - grids[a][0])[:, None, None] * turned
        uncertainties.append(entry_u(sources, fixed))
    return NineTables(grids, (corrections[0], corrections[1], corrections[2]), (uncertainties[0], uncertainties[1], uncertainties[2]))


def entry_u(sources: ErrorSources, per_unit: F3) -> F2:
    """Return the standard uncertainty of table entries, shape (n, 3); ``per_unit``: entries per unit of each coefficient."""
    return np.asarray(np.sqrt(variances(sources, per_unit.reshape(-1, per_unit.shape[2]))).reshape(per_unit.shape[:2]))


def table_design(
    solution: JointSolution, grids_mm: tuple[F1, F1, F1], nodes: int, terms: tuple[Term, ...] | None = None
) -> tuple[F3, F3, F3]:
    """Return, for one unit of every coefficient, the nine tables that fit its deviation best: per axis an array (len(grid), 3, terms).

    The first entry of every table is zero.

    ``terms``: by default those of the solution; may include higher orders, which have only an uncertainty.
    """
    x, y, z = (effect - effect[0] for effect in additive_design(solution, grids_mm, nodes, terms))
    return x, y, z


def frame_rotation(machine: Machine, terms: tuple[Term, ...], nodes: int) -> F2:
    """Return the best-fit rotation of the deviation over the volume per unit of every coefficient, rad, shape (3, terms)."""
    grid = volume_grid(machine.stroke_mm, nodes)
    full = design(machine, terms, grid).reshape(-1, len(terms))
    return np.asarray(np.linalg.lstsq(rigid_design(grid).reshape(-1, 6), full, rcond=None)[0][3:])


def predict_residual(solution: JointSolution, tables: NineTables, *, nodes: int = 9, sources: ErrorSources | None = None) -> Predicted:
    """Predict the rms error of the machine without and with these tables, and the uncertainty of the model."""
    machine = solution.machine
    grid = volume_grid(machine.stroke_mm, nodes)
    field = solution.deviation_mm(grid)
    corrected = field + tables.correction_at(grid)

    def rms(v: F2) -> float:
        return float(np.sqrt(np.mean(np.sum(remove_rigid(grid, v) ** 2, axis=1))))

    return Predicted(rms(field), rms(corrected), model_uncertainty_mm(solution, nodes=nodes, sources=sources))


def model_uncertainty_mm(solution: JointSolution, *, nodes: int = 9, sources: ErrorSources | None = None) -> float:
    """Return the rms over the volume of the standard uncertainty of the identified deviation vector, rigid motion removed, mm.

    All sources are included: noise, set-ups, typical sizes, higher orders, wavelength, temperatures.
    """
    grid = volume_grid(solution.machine.stroke_mm, nodes)
    return budget_over(predict_deviation(sources or error_sources(solution), grid, frame=RigidFree(grid))).u_mm
