"""Tables for controllers that take less than nine: positioning alone, cross tables beside it, squareness as a parameter.

Nothing is counted twice: what one part holds is not in the others, and all parts together correct what the nine tables correct (but for a
rotation of the frame, which squareness parameters cannot hold and which moves no distance).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from models.arrays import F1, F2, F3
from models.compensation.summary import SQUARENESS, MeanParameter, mean_linear
from models.compensation.tables import NineTables, grid_positions, nine_tables, table_design
from models.solvers.joint import JointSolution


def positioning_only(tables: NineTables) -> NineTables:
    """The three own-axis tables of nine (pitch error compensation), everything else zero."""
    return _kept(tables, lambda a: np.arange(3) == a)


def cross_only(tables: NineTables) -> NineTables:
    """The six cross tables of nine, own-axis tables zero: to be used beside `positioning_only`, which holds the scale already."""
    return _kept(tables, lambda a: np.arange(3) != a)


@dataclass(frozen=True, eq=False)
class SquarenessTables:
    """Squareness as three parameters (C0Y, B0Z, A0Z, rad, with u), and tables that hold none of it.

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


def squareness_tables(solution: JointSolution, counts: tuple[int, int, int], *, nodes: int = 9) -> SquarenessTables:
    """Nine tables with squareness taken out of them; parameters as `nine_tables`.

    The parameters are least-squares slopes of the tables themselves; their uncertainty is that of the mean squareness over the volume.
    """
    nine = nine_tables(solution, counts, nodes=nodes)
    grids = grid_positions(solution.machine, counts)
    corrections: list[F2] = []
    uncertainties: list[F2] = []
    slopes = np.zeros((3, 3))
    for a, design in enumerate(table_design(solution, grids, nodes)):
        cross = np.arange(3) != a
        travel = grids[a] - grids[a][0]
        weight = (travel - travel.mean()) / np.sum((travel - travel.mean()) ** 2)
        straight: F3 = design - travel[:, None, None] * np.einsum("n,nik->ik", weight, design)
        variance = np.einsum("nik,kl,nil->ni", straight, solution.term_covariance, straight)
        slopes[a] = np.einsum("n,nik->ik", weight, design) @ solution.coefficients
        corrections.append(np.where(cross, -(straight @ solution.coefficients), nine.correction_mm[a]))
        uncertainties.append(np.where(cross, np.sqrt(np.maximum(variance, 0.0)), nine.u_mm[a]))
    u = {p.name: p.u for p in mean_linear(solution, nodes=nodes)}
    found = tuple(MeanParameter(name, float(sign * (slopes[a, b] + slopes[b, a])), u[name]) for name, a, b, sign in SQUARENESS)
    tables = NineTables(grids, (corrections[0], corrections[1], corrections[2]), (uncertainties[0], uncertainties[1], uncertainties[2]))
    return SquarenessTables(found, tables, np.array([g[0] for g in grids]))


def _kept(tables: NineTables, keep: Callable[[int], np.ndarray[tuple[int, ...], np.dtype[np.bool_]]]) -> NineTables:
    corrections = [np.where(keep(a), tables.correction_mm[a], 0.0) for a in range(3)]
    uncertainties = [np.where(keep(a), tables.u_mm[a], 0.0) for a in range(3)]
    return NineTables(
        tables.position_mm, (corrections[0], corrections[1], corrections[2]), (uncertainties[0], uncertainties[1], uncertainties[2])
    )
