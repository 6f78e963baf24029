"""Tables for controllers that take less than nine: positioning alone, cross tables beside it, squareness as a parameter.

Nothing is counted twice: what one part holds is not in the others, and all parts together correct what the nine tables correct (but for a
rotation of the frame, which squareness parameters cannot hold and which moves no distance).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.compensation.summary import SQUARENESS, MeanParameter, mean_parameter
from abbe.models.compensation.tables import NineTables, entry_u, grid_positions, nine_tables, table_design
from abbe.models.solvers.joint import JointSolution
from abbe.models.uncertainty.sources import ErrorSources, error_sources


def positioning_only(tables: NineTables) -> NineTables:
    """The three own-axis tables of nine (pitch error compensation), everything else zero."""
    return _kept(tables, lambda a: np.arange(3) == a)


def cross_only(tables: NineTables) -> NineTables:
    """The six cross tables of nine, own-axis tables zero: to be used beside `positioning_only`, which holds the scale already."""
    return _kept(tables, lambda a: np.arange(3) != a)


@dataclass(frozen=True, eq=False)
class SquarenessTables:
    """Squareness as three parameters (C0Y, B0Z, A0Z, rad, with u), and tables that hold none of it.

    The parameters are the squareness of these tables, which count the body diagonals as much as the volume: not the mean squareness over
    the volume (`abbe.models.compensation.summary.mean_linear`), from which it can differ by more than its uncertainty.

    ``tables``: own-axis tables as before; cross tables without slope, so straightness alone. What their slopes held beyond squareness was a
    rotation of the frame: it is left out. ``start_mm``: position of each axis at which the parameters correct nothing.
    """

    parameters: tuple[MeanParameter, ...]
    tables: NineTables
    start_mm: F1

    def squareness_at(self, axes_mm: F2) -> F2:
        """What the parameters alone add at commanded positions, shape (n, 3), mm: +C0Y y to X, −B0Z z to X, +A0Z z to Y."""
        out = np.zeros((axes_mm.shape[0], 3))
        for parameter, (_, first, second, sign) in zip(self.parameters, SQUARENESS, strict=True):
            out[:, first] -= sign * parameter.value * (axes_mm[:, second] - self.start_mm[second])
        return out

    def correction_at(self, axes_mm: F2) -> F2:
        """Parameters and tables together, shape (n, 3), mm."""
        return self.squareness_at(axes_mm) + self.tables.correction_at(axes_mm)


def squareness_tables(
    solution: JointSolution, counts: tuple[int, int, int], *, nodes: int = 9, sources: ErrorSources | None = None
) -> SquarenessTables:
    """Nine tables with squareness taken out of them; parameters as `nine_tables`.

    The squareness parameters are least-squares slopes of the tables themselves, and their uncertainty that of the same slopes.
    """
    sources = sources or error_sources(solution)
    nine = nine_tables(solution, counts, nodes=nodes, sources=sources)
    grids = grid_positions(solution.machine, counts)
    corrections: list[F2] = []
    uncertainties: list[F2] = []
    slopes: list[F2] = []  # of outputs over axis a, per unit of every coefficient, (3, terms)
    for a, design in enumerate(table_design(solution, grids, nodes, sources.terms)):
        cross = np.arange(3) != a
        travel = grids[a] - grids[a][0]
        weight = (travel - travel.mean()) / np.sum((travel - travel.mean()) ** 2)
        slopes.append(np.einsum("n,nik->ik", weight, design))
        straight: F3 = design - travel[:, None, None] * slopes[a]
        corrections.append(np.where(cross, -(straight @ sources.coefficients), nine.correction_mm[a]))
        uncertainties.append(np.where(cross, entry_u(sources, straight), nine.u_mm[a]))
    found = tuple(mean_parameter(sources, name, sign * (slopes[a][b] + slopes[b][a])) for name, a, b, sign in SQUARENESS)
    tables = NineTables(grids, (corrections[0], corrections[1], corrections[2]), (uncertainties[0], uncertainties[1], uncertainties[2]))
    return SquarenessTables(found, tables, np.array([g[0] for g in grids]))


def _kept(tables: NineTables, keep: Callable[[int], np.ndarray[tuple[int, ...], np.dtype[np.bool_]]]) -> NineTables:
    corrections = [np.where(keep(a), tables.correction_mm[a], 0.0) for a in range(3)]
    uncertainties = [np.where(keep(a), tables.u_mm[a], 0.0) for a in range(3)]
    return NineTables(
        tables.position_mm, (corrections[0], corrections[1], corrections[2]), (uncertainties[0], uncertainties[1], uncertainties[2])
    )
