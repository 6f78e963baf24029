"""Achievable accuracy of each kind of table on this machine: residual errors of distances with their uncertainty.

All kinds are made from the same identified deviation; its unknown part (`PredictedDistances.unknown_mm`) is in every row. The errors are
those over the inner 80 % of the strokes, to first order; distances do not contain rigid motion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.compensation.correction import Correction
from abbe.models.compensation.distances import (
    Pairs,
    PredictedDistances,
    correction_error_mm,
    inner_box_mm,
    predict_distances,
    random_pairs,
)
from abbe.models.compensation.grid import Mask, grid_table, quantise_grid
from abbe.models.compensation.per_motion import enough_for_the_field, motion_tables, observable_alone
from abbe.models.compensation.summary import SQUARENESS, MeanParameter, mean_parameter
from abbe.models.compensation.tables import NineTables, entry_u, grid_positions, nine_tables, quantise, table_design
from abbe.models.solvers.joint import JointSolution
from abbe.models.uncertainty.sources import ErrorSources, error_sources

# Tables for controllers that take less than nine: positioning alone, cross tables beside it, squareness as a parameter.
#
# No correction is in two parts, and all parts together correct the same as the nine tables (but for a rotation of the frame, which
# squareness parameters cannot express and which changes no distance).


def positioning_only(tables: NineTables) -> NineTables:
    """The three own-axis tables of nine (pitch error compensation), everything else zero."""
    return _kept(tables, lambda a: np.arange(3) == a)


def cross_only(tables: NineTables) -> NineTables:
    """The six cross tables of nine, own-axis tables zero: to be used beside `positioning_only`, which contains the scale."""
    return _kept(tables, lambda a: np.arange(3) != a)


@dataclass(frozen=True, eq=False)
class SquarenessTables:
    """Squareness as three parameters (C0Y, B0Z, A0Z, rad, with u), and tables without squareness.

    The parameters are the squareness of these tables, which count the body diagonals as much as the volume: not the mean squareness over
    the volume (`abbe.models.compensation.summary.mean_linear`), from which it can differ by more than its uncertainty.

    ``tables``: own-axis tables as before; cross tables without slope, so straightness alone. The rest of their slopes was a rotation of the
    frame and is left out. ``start_mm``: position of each axis at which the parameters correct nothing.
    """

    parameters: tuple[MeanParameter, ...]
    tables: NineTables
    start_mm: F1

    def squareness_at(self, axes_mm: F2) -> F2:
        """Correction by the parameters alone at commanded positions, shape (n, 3), mm: +C0Y y to X, −B0Z z to X, +A0Z z to Y."""
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


ONE_AXIS_COUNTS = (25, 25, 25)
GRID_NODES = (5, 9, 13, 17)


@dataclass(frozen=True)
class Achievable:
    """One kind of table.

    Attributes
    ----------
    kind : str
        Name for the user.
    entries : int
        Number of values in the controller.
    distances : PredictedDistances
        Residual errors with the table as stored, rounding included.
    rounding_mm : float
        Rms share of the distance errors that comes from rounding to the controller's unit alone; 0 without a unit.
    """

    kind: str
    entries: int
    distances: PredictedDistances
    rounding_mm: float


def achievable(
    solution: JointSolution,
    *,
    counts: tuple[int, int, int] = ONE_AXIS_COUNTS,
    grid_nodes: tuple[int, ...] = GRID_NODES,
    lsb_mm: float = 0.0,
    observable: frozenset[str] | None = None,
    sources: ErrorSources | None = None,
) -> tuple[Achievable, ...]:
    """Every kind of table on this machine, from none to the finest grid.

    Parameters
    ----------
    counts : (int, int, int)
        Points of one-axis tables on X, Y, Z.
    grid_nodes : tuple of int
        Nodes per axis of the 3-D grids.
    lsb_mm : float
        The controller's unit; 0: no rounding. Tables of single motions and squareness parameters are not rounded.
    observable : set of str, optional
        Motions that are observable by themselves; default: `observable_alone`.
    sources : ErrorSources, optional
        Sources of uncertainty, with the stated inputs they rest on; default: ``error_sources(solution)``, so the documented inputs.
    """
    judge = _ResidualJudge(solution, random_pairs(inner_box_mm(solution.machine)), sources or error_sources(solution), lsb_mm)
    rows = [judge.row("no table", 0), *judge.one_axis(counts), *judge.single_motions(counts, observable)]
    return (*rows, *(judge.grid(n, None) for n in grid_nodes))


def grid_row(
    solution: JointSolution,
    nodes: int,
    *,
    lsb_mm: float = 0.0,
    compensable: Mask | None = None,
    pairs: Pairs | None = None,
    sources: ErrorSources | None = None,
) -> Achievable:
    """Residual errors with a 3-D grid of ``nodes`` per axis; other parameters as `achievable`."""
    judge = _ResidualJudge(solution, pairs or random_pairs(inner_box_mm(solution.machine)), sources or error_sources(solution), lsb_mm)
    return judge.grid(nodes, compensable)


@dataclass(frozen=True, eq=False)
class _ResidualJudge:
    """Common basis for all kinds of table: pairs, sources of uncertainty, rounding."""

    solution: JointSolution
    pairs: Pairs
    sources: ErrorSources
    lsb_mm: float

    def row(self, kind: str, entries: int, stored: Correction | None = None, exact: Correction | None = None) -> Achievable:
        """Row of a kind of table from its correction as stored, and without rounding."""
        rounding = 0.0
        if stored is not None and exact is not None:
            added = correction_error_mm(stored, self.pairs) - correction_error_mm(exact, self.pairs)
            rounding = float(np.sqrt(np.mean(added**2)))
        return Achievable(kind, entries, predict_distances(self.solution, stored, pairs=self.pairs, sources=self.sources), rounding)

    def one_axis(self, counts: tuple[int, int, int]) -> list[Achievable]:
        """Positioning alone, with squareness, and all nine."""
        nine = nine_tables(self.solution, counts, sources=self.sources)
        square = squareness_tables(self.solution, counts, sources=self.sources)
        alone = positioning_only(nine)
        stored = self._stored(alone)
        return [
            self.row("positioning tables", sum(counts), stored.correction_at, alone.correction_at),
            self.row(
                "positioning tables and squareness",
                sum(counts) + 3,
                lambda p: stored.correction_at(p) + square.squareness_at(p),
                lambda p: alone.correction_at(p) + square.squareness_at(p),
            ),
            self.row("nine tables", 3 * sum(counts), self._stored(nine).correction_at, nine.correction_at),
        ]

    def single_motions(self, counts: tuple[int, int, int], observable: frozenset[str] | None) -> list[Achievable]:
        """Tables of motions under their own names."""
        seen = observable_alone(self.solution) if observable is None else observable
        out = []
        for kind, motions, any_tool in (
            ("tables of the motions that are observable by themselves", seen, True),
            ("tables of single motions, right for this tool only", enough_for_the_field(self.solution), False),
        ):
            if motions:
                tables = motion_tables(self.solution, counts, motions, any_tool=any_tool, sources=self.sources)
                out.append(self.row(kind, sum(v.size for v in tables.motions.values()) + 3, tables.correction_at))
        return out

    def grid(self, nodes: int, compensable: Mask | None) -> Achievable:
        """A grid of ``nodes`` per axis."""
        table = grid_table(self.solution, (nodes,) * 3, compensable=compensable, sources=self.sources)
        stored = quantise_grid(table, self.lsb_mm) if self.lsb_mm > 0 else table
        return self.row(f"grid {nodes} x {nodes} x {nodes}", 3 * nodes**3, stored.correction_at, table.correction_at)

    def _stored(self, tables: NineTables) -> NineTables:
        return quantise(tables, self.lsb_mm) if self.lsb_mm > 0 else tables
