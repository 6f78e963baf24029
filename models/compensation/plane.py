"""One-axis tables from a deviation that is known in a part of one plane only: there the two axes of the plane correct each other.

Beyond the known part the tables hold their end values: there, and at every other position of the third axis, they are assumed. The third
axis is neither moved nor corrected.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.compensation.tables import NineTables, Predicted, grid_positions
from abbe.models.machine import Machine

Known = Callable[[F2], tuple[F2, F2]]
"""Deviation and standard uncertainty at positions, mm, shape (n, 3) each; NaN in a direction that is not known."""
NODES = 13


def plane_tables(machine: Machine, box_mm: F2, known: Known, counts: tuple[int, int, int]) -> tuple[NineTables, Predicted]:
    """Return the best tables of the plane, and the rms in it before and after them.

    Parameters
    ----------
    box_mm : array, shape (3, 2)
        Part of the strokes in which the deviation is known; the third axis has an extent of zero.
    known : function
        `Known`; rigid motion removed over the points that it is asked for.
    counts : (int, int, int)
        Grid points of X, Y, Z.
    """
    grids = grid_positions(machine, counts)
    moving = [a for a in range(3) if box_mm[a, 1] > box_mm[a, 0]]
    nodes = [np.linspace(box_mm[a, 0], box_mm[a, 1], NODES) if a in moving else box_mm[a, :1] for a in range(3)]
    points = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(-1, 3)
    value, u = (np.nan_to_num(v) for v in known(points))
    correction, spread = [np.zeros((g.size, 3)) for g in grids], [np.zeros((g.size, 3)) for g in grids]
    for a in moving:
        at = np.unique(points[:, a])
        for i in moving:
            mean = np.array([value[points[:, a] == x, i].mean() for x in at])
            doubt = np.array([np.sqrt(np.mean(u[points[:, a] == x, i] ** 2)) for x in at])
            correction[a][:, i] = _from_first(np.interp(grids[a], at, -mean))
            spread[a][:, i] = np.interp(grids[a], at, doubt)
    tables = NineTables(grids, (correction[0], correction[1], correction[2]), (spread[0], spread[1], spread[2]))
    left = value + tables.correction_at(points)
    return tables, Predicted(_size(value[:, moving]), _size(_in_plane(points[:, moving], left[:, moving])), _size(u[:, moving]))


def _from_first(values: F1) -> F1:
    return np.asarray(values - values[0])


def _in_plane(at: F2, values: F2) -> F2:
    """Remove the best-fit rigid motion in the plane, shape (n, 2)."""
    away = at - at.mean(axis=0)
    rigid = np.zeros((*away.shape, 3))
    rigid[:, 0, 0] = rigid[:, 1, 1] = 1.0
    rigid[:, :, 2] = np.stack([-away[:, 1], away[:, 0]], axis=1)
    rows, y = rigid.reshape(-1, 3), values.reshape(-1)
    return np.asarray((y - rows @ np.linalg.lstsq(rows, y, rcond=None)[0]).reshape(values.shape))


def _size(values: F2) -> float:
    return float(np.sqrt(np.mean(np.sum(values**2, axis=1))))
