"""Nine one-axis tables: correction of each axis as a function of each axis, on the controller's grid.

The best nine tables approximate the deviation field by a sum of functions of one axis (`abbe.models.compensation.additive`). The effect of
angles at a lever that depends on two axes remains; a 3-D grid (`abbe.models.compensation.grid`) corrects it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Legendre

from abbe.models.arrays import F1, F2, F3
from abbe.models.compensation.additive import additive_design
from abbe.models.geometry.bases import Term
from abbe.models.geometry.chain import design
from abbe.models.geometry.volume import RigidFree, remove_rigid, rigid_design, volume_grid
from abbe.models.machine import AXES, Machine
from abbe.models.solvers.joint import JointSolution
from abbe.models.uncertainty.prediction import budget_over, predict_deviation
from abbe.models.uncertainty.sources import ErrorSources, error_sources, variances


@dataclass(frozen=True)
class NineTables:
    """Corrections added to the command: ``correction_mm[a][:, i]`` is added to axis i at the positions ``position_mm[a]`` of axis a.

    ``u_mm``, of the same shapes: standard uncertainty of each entry relative to the first one of its table, from all sources
    (`abbe.models.uncertainty.sources`), in the frame without rigid motion over the volume (docs/explanation/conventions.md, "Frame"). The
    slope of a cross table is partly a rotation of the whole frame. No reading shows this rotation, it changes no distance on a part, and
    its value here is arbitrary: remove the best-fit rotation before you compare tables.
    """

    position_mm: tuple[F1, F1, F1]
    correction_mm: tuple[F2, F2, F2]
    u_mm: tuple[F2, F2, F2]

    def correction_at(self, axes_mm: F2) -> F2:
        """Return the correction at commanded positions, mm, shape (n, 3): linear, constant beyond the grid."""
        out = np.zeros((axes_mm.shape[0], 3))
        for a in range(3):
            for i in range(3):
                out[:, i] += np.interp(axes_mm[:, a], self.position_mm[a], self.correction_mm[a][:, i])
        return out


def grid_positions(machine: Machine, counts: tuple[int, int, int]) -> tuple[F1, F1, F1]:
    """Return an equidistant grid per axis over its stroke, the pitch rounded down to 10 nm so that the controller stores it exactly."""
    grids = []
    for a, n in enumerate(counts):
        if n < 2:
            raise ValueError(f"table grid of {AXES[a]}: {n} points given, at least 2 needed")
        pitch = np.floor(machine.length_mm[a] / (n - 1) * 1e5) / 1e5
        grids.append(machine.stroke_mm[a, 0] + pitch * np.arange(n))
    return grids[0], grids[1], grids[2]


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
    """Return the standard uncertainty of table entries, shape (n, 3), from their values ``per_unit`` of each coefficient."""
    return np.asarray(np.sqrt(variances(sources, per_unit.reshape(-1, per_unit.shape[2]))).reshape(per_unit.shape[:2]))


def table_design(
    solution: JointSolution, grids_mm: tuple[F1, F1, F1], nodes: int, terms: tuple[Term, ...] | None = None
) -> tuple[F3, F3, F3]:
    """Return the best nine tables of the deviation per unit of every coefficient, first entries zero: per axis (len(grid), 3, terms).

    ``terms``: default the solution's own; may hold higher orders too, which have an uncertainty only.
    """
    x, y, z = (effect - effect[0] for effect in additive_design(solution, grids_mm, nodes, terms))
    return x, y, z


def frame_rotation(machine: Machine, terms: tuple[Term, ...], nodes: int) -> F2:
    """Return the best-fit rotation of the deviation over the volume per unit of every coefficient, rad, shape (3, terms)."""
    grid = volume_grid(machine.stroke_mm, nodes)
    full = design(machine, terms, grid).reshape(-1, len(terms))
    return np.asarray(np.linalg.lstsq(rigid_design(grid).reshape(-1, 6), full, rcond=None)[0][3:])


def quantise(tables: NineTables, lsb_mm: float) -> NineTables:
    """Return the tables as the controller stores them: every entry rounded to the controller's unit.

    Raises
    ------
    ValueError
        The unit is not a positive number.
    """
    check_unit(lsb_mm)
    rounded = tuple(np.round(c / lsb_mm) * lsb_mm for c in tables.correction_mm)
    return NineTables(tables.position_mm, (rounded[0], rounded[1], rounded[2]), tables.u_mm)


def check_unit(lsb_mm: float) -> None:
    """Refuse a controller's unit that is not a positive number; entries cannot be rounded to it."""
    if not (np.isfinite(lsb_mm) and lsb_mm > 0):
        raise ValueError(f"tables: the controller's unit is {lsb_mm} mm, but must be a positive number")


@dataclass(frozen=True, slots=True)
class Predicted:
    """Predicted volumetric rms error (rigid motion removed) before and after correction, and `model_uncertainty_mm`, mm."""

    before_mm: float
    after_mm: float
    u_model_mm: float


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

    It includes all sources: noise, set-ups, typical sizes, higher orders, wavelength, temperatures.
    """
    grid = volume_grid(solution.machine.stroke_mm, nodes)
    return budget_over(predict_deviation(sources or error_sources(solution), grid, frame=RigidFree(grid))).u_mm


WITHIN_MM = 5e-4
"""Largest difference, mm, between a smooth table and its polynomial; tables that differ more hold pitch errors or manual entries."""
ORDERS = range(2, 13)


def smooth_of(tables: NineTables) -> Callable[[F2], F2] | None:
    """Fit polynomials to nine tables; return the correction (n, 3), mm, as a function of positions (n, 3), or None if a fit fails.

    Each table gets the lowest order from 2 to 12 that fits its entries within 0.5 µm. The polynomials are free of interpolation corners,
    rounding and cut ends, which a solver would take for motions of high order.
    """
    found = [[_meets(tables.position_mm[a], tables.correction_mm[a][:, i]) for i in range(3)] for a in range(3)]
    if any(one is None for row in found for one in row):
        return None
    whole = [[one for one in row if one is not None] for row in found]

    def correction_mm(axes_mm: F2) -> F2:
        inside = [np.clip(axes_mm[:, a], tables.position_mm[a][0], tables.position_mm[a][-1]) for a in range(3)]
        return np.stack([sum((whole[a][i](inside[a]) for a in range(3)), np.zeros(len(axes_mm))) for i in range(3)], axis=1)

    return correction_mm


def _meets(position_mm: F1, correction_mm: F1) -> Legendre | None:
    for order in ORDERS:
        if order >= position_mm.size - 1:
            return None
        one = Legendre.fit(position_mm, correction_mm, order)
        if float(np.abs(one(position_mm) - correction_mm).max()) <= WITHIN_MM:
            return one
    return None
