"""One-axis tables from a deviation that is known in a part of the strokes only: in planes at one or several heights, or in a box.

Every axis along which this part extends gets corrections in the directions in which the deviation was sensed; all others are zero. The
tables rest on two assumptions: beyond the known part a table keeps its end value, and at heights without a plane the corrections are those
of the planes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.compensation.tables import NineTables, Predicted, grid_positions
from abbe.models.machine import Machine

Known = Callable[[F2], tuple[F2, F2]]
"""Deviation and standard uncertainty at positions, mm, shape (n, 3) each; NaN in a direction that is not known."""
NODES = {2: 13, 3: 7}


def partial_tables(machine: Machine, boxes_mm: Sequence[F2], known: Known, counts: tuple[int, int, int]) -> tuple[NineTables, Predicted]:
    """Return the tables that are best over all boxes together, and the rms in the boxes before and after the tables.

    Parameters
    ----------
    boxes_mm : sequence of arrays, shape (3, 2)
        Parts of the strokes in which the deviation is known, except for one unknown rigid motion per part. Planes have an extent of zero
        along their third axis; all boxes are spanned by the same axes.
    known : function
        Returns deviation and uncertainty (`Known`) at points, without the rigid motion over these points.
    counts : (int, int, int)
        Grid points of X, Y, Z.
    """
    grids = grid_positions(machine, counts)
    moving = [a for a in range(3) if boxes_mm[0][a, 1] > boxes_mm[0][a, 0]]
    points = [_nodes(box, moving) for box in boxes_mm]
    found = [known(p) for p in points]
    sensed = [i for i in range(3) if not np.isnan(found[0][0][:, i]).any()]
    value, u = (np.nan_to_num(np.concatenate(parts)) for parts in zip(*found, strict=True))
    places = np.concatenate(points)
    correction, spread = [np.zeros((g.size, 3)) for g in grids], [np.zeros((g.size, 3)) for g in grids]
    for a in moving:
        at = np.unique(places[:, a])
        rows = [np.flatnonzero(places[:, a] == x) for x in at]
        for i in sensed:
            correction[a][:, i] = _from_first(np.interp(grids[a], at, [-value[r, i].mean() for r in rows]))
            spread[a][:, i] = np.interp(grids[a], at, [np.sqrt(np.mean(u[r, i] ** 2)) for r in rows])
    tables = NineTables(grids, (correction[0], correction[1], correction[2]), (spread[0], spread[1], spread[2]))
    parts = np.split(value + tables.correction_at(places), np.cumsum([len(p) for p in points])[:-1])
    left = np.concatenate([_without_motion(p, v, sensed) for p, v in zip(points, parts, strict=True)])
    return tables, Predicted(_size(value[:, sensed]), _size(left), _size(u[:, sensed]))


def _nodes(box_mm: F2, moving: list[int]) -> F2:
    nodes = [np.linspace(box_mm[a, 0], box_mm[a, 1], NODES[len(moving)]) if a in moving else box_mm[a, :1] for a in range(3)]
    return np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(-1, 3)


def _from_first(values: F1) -> F1:
    return np.asarray(values - values[0])


def _without_motion(at: F2, values: F2, sensed: list[int]) -> F2:
    """Remove the best-fit rigid motion in the sensed directions, shape (n, sensed)."""
    away, unit = at - at.mean(axis=0), np.eye(3)
    turns = [k for k in range(3) if len(sensed) == 3 or k not in sensed]
    columns = [np.tile(unit[k], (len(at), 1)) for k in sensed] + [np.cross(unit[k], away) for k in turns]
    rows, y = np.stack(columns, axis=-1)[:, sensed].reshape(-1, len(columns)), values[:, sensed].reshape(-1)
    return np.asarray((y - rows @ np.linalg.lstsq(rows, y, rcond=None)[0]).reshape(-1, len(sensed)))


def _size(values: F2) -> float:
    return float(np.sqrt(np.mean(np.sum(values**2, axis=1))))
