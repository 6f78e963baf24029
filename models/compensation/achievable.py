"""What each kind of table can do for this machine: the errors of distances that are left, with their uncertainty, side by side.

All kinds are made from the same identified deviation; the part of it that nobody knows (`PredictedDistances.unknown_mm`) is in every row.
Judged over the inner 80 % of the strokes, first order, rigid motion not seen by distances.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models.compensation.correction import Correction
from models.compensation.distances import (
    Pairs,
    PredictedDistances,
    correction_error_mm,
    inner_box_mm,
    predict_distances,
    random_pairs,
)
from models.compensation.grid import Mask, grid_table, quantise_grid
from models.compensation.one_axis import positioning_only, squareness_tables
from models.compensation.per_motion import enough_for_the_field, motion_tables, observable_alone
from models.compensation.tables import NineTables, nine_tables, quantise
from models.solvers.joint import JointSolution

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
    """
    pairs = random_pairs(inner_box_mm(solution.machine))
    nine = nine_tables(solution, counts)
    square = squareness_tables(solution, counts)
    alone = positioning_only(nine)
    rows = [_row(solution, pairs, "no table", 0)]
    rows.append(_one_axis(solution, pairs, "positioning tables", alone, lsb_mm, outputs=1))
    stored = _stored(alone, lsb_mm)
    both = _row(
        solution,
        pairs,
        "positioning tables and squareness",
        sum(counts) + 3,
        lambda p: stored.correction_at(p) + square.squareness_at(p),
        lambda p: alone.correction_at(p) + square.squareness_at(p),
    )
    rows += [both, _one_axis(solution, pairs, "nine tables", nine, lsb_mm, outputs=3)]
    seen = observable_alone(solution) if observable is None else observable
    for kind, motions, any_tool in (
        ("tables of the motions that are observable by themselves", seen, True),
        ("tables of single motions, right for this tool only", enough_for_the_field(solution), False),
    ):
        if motions:
            tables = motion_tables(solution, counts, motions, any_tool=any_tool)
            rows.append(_row(solution, pairs, kind, sum(v.size for v in tables.motions.values()) + 3, tables.correction_at))
    rows += [grid_row(solution, n, lsb_mm=lsb_mm, pairs=pairs) for n in grid_nodes]
    return tuple(rows)


def grid_row(
    solution: JointSolution, nodes: int, *, lsb_mm: float = 0.0, compensable: Mask | None = None, pairs: Pairs | None = None
) -> Achievable:
    """What a 3-D grid of so many nodes per axis leaves."""
    table = grid_table(solution, (nodes,) * 3, compensable=compensable)
    stored = quantise_grid(table, lsb_mm) if lsb_mm > 0 else table
    pairs = pairs or random_pairs(inner_box_mm(solution.machine))
    return _row(solution, pairs, f"grid {nodes} x {nodes} x {nodes}", 3 * nodes**3, stored.correction_at, table.correction_at)


def _one_axis(solution: JointSolution, pairs: Pairs, kind: str, tables: NineTables, lsb_mm: float, *, outputs: int) -> Achievable:
    entries = outputs * sum(p.size for p in tables.position_mm)
    return _row(solution, pairs, kind, entries, _stored(tables, lsb_mm).correction_at, tables.correction_at)


def _stored(tables: NineTables, lsb_mm: float) -> NineTables:
    return quantise(tables, lsb_mm) if lsb_mm > 0 else tables


def _row(
    solution: JointSolution,
    pairs: Pairs,
    kind: str,
    entries: int,
    stored: Correction | None = None,
    exact: Correction | None = None,
) -> Achievable:
    rounding = 0.0
    if stored is not None and exact is not None:
        rounding = float(np.sqrt(np.mean((correction_error_mm(stored, pairs) - correction_error_mm(exact, pairs)) ** 2)))
    return Achievable(kind, entries, predict_distances(solution, stored, pairs=pairs), rounding)
