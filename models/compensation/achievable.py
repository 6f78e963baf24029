"""What each kind of table can do for this machine: the errors of distances that are left, with their uncertainty, side by side.

All kinds are made from the same identified deviation; the part of it that nobody knows (`PredictedDistances.unknown_mm`) is in every row.
Judged over the inner 80 % of the strokes, first order, rigid motion not seen by distances.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
from abbe.models.compensation.one_axis import positioning_only, squareness_tables
from abbe.models.compensation.per_motion import enough_for_the_field, motion_tables, observable_alone
from abbe.models.compensation.tables import NineTables, nine_tables, quantise
from abbe.models.solvers.joint import JointSolution
from abbe.models.uncertainty.sources import ErrorSources, error_sources

ONE_AXIS_COUNTS = (25, 25, 25)
GRID_NODES = (5, 9, 13, 17)


@dataclass(frozen=True)
class Achievable:
    """One kind of table.

    Attributes
    ----------
    kind : str
        In the user's words.
    entries : int
        Numbers that the controller has to hold.
    distances : PredictedDistances
        What is left with the table as stored, rounding included.
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
    judge = _Judge(solution, random_pairs(inner_box_mm(solution.machine)), sources or error_sources(solution), lsb_mm)
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
    """What a 3-D grid of so many nodes per axis leaves; other parameters as `achievable`."""
    judge = _Judge(solution, pairs or random_pairs(inner_box_mm(solution.machine)), sources or error_sources(solution), lsb_mm)
    return judge.grid(nodes, compensable)


@dataclass(frozen=True, eq=False)
class _Judge:
    """What all kinds of table are judged with: the same pairs, the same sources of uncertainty, the same rounding."""

    solution: JointSolution
    pairs: Pairs
    sources: ErrorSources
    lsb_mm: float

    def row(self, kind: str, entries: int, stored: Correction | None = None, exact: Correction | None = None) -> Achievable:
        """A kind of table by what the controller adds, and what it would add without rounding."""
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
        """A grid of so many nodes per axis."""
        table = grid_table(self.solution, (nodes,) * 3, compensable=compensable, sources=self.sources)
        stored = quantise_grid(table, self.lsb_mm) if self.lsb_mm > 0 else table
        return self.row(f"grid {nodes} x {nodes} x {nodes}", 3 * nodes**3, stored.correction_at, table.correction_at)

    def _stored(self, tables: NineTables) -> NineTables:
        return quantise(tables, self.lsb_mm) if self.lsb_mm > 0 else tables
