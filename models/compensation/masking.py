"""Where a deviation is known worse than it is large, nothing is compensated; what then happens at the border.

The rule. All nodes that are not compensated hold one and the same correction: no distance between two of them changes. The compensated
nodes hold minus the deviation, in the frame (rigid motion) that makes the errors of the distances across the border least. Between a
compensated and an uncompensated node the correction runs linearly over one cell, as everywhere else.

The promise. By the identified field, the sum of squares of the errors of distances (fixed pairs over the whole volume) is never larger
than without any correction. The unknown part of the field is the same with and without: so it holds for the expected error too. Where the
rule could not keep the promise - a mask that cuts a smooth error into pieces can do that - nothing at all is compensated.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2, F3, F4
from abbe.models.compensation.distances import Pairs, random_pairs
from abbe.models.compensation.interpolation import trilinear
from abbe.models.volumetric import rigid_design

SMALL_CORRECTIONS = 1e-2
"""Weight of "corrections are small" against "distances are right": it decides only the frame of a mask of a few nodes."""


def blend(position_mm: tuple[F1, F1, F1], error_mm: F4, compensable: NDArray[np.bool_]) -> tuple[F4, NDArray[np.bool_]]:
    """Corrections at the nodes and the nodes that are compensated.

    Parameters
    ----------
    position_mm : three arrays
        Nodes of X, Y, Z.
    error_mm : array, shape (nx, ny, nz, 3)
        Deviation at the nodes, in any frame.
    compensable : array of bool, shape (nx, ny, nz)

    Returns
    -------
    correction_mm : array, shape (nx, ny, nz, 3)
        Zero where nothing is compensated.
    compensated : array of bool, shape (nx, ny, nz)
    """
    shape = error_mm.shape
    points = np.stack(np.meshgrid(*position_mm, indexing="ij"), axis=-1).reshape(-1, 3)
    free = np.repeat(compensable.reshape(-1)[:, None], 3, axis=1)
    error = error_mm.reshape(-1, 3)
    rigid = rigid_design(points)
    pairs = random_pairs(np.array([[p[0], p[-1]] for p in position_mm]))

    left = _distance_errors(position_mm, np.where(free, 0.0, error)[:, :, None], pairs)[:, 0]
    moved = _distance_errors(position_mm, rigid * free[:, :, None], pairs)
    weight = np.sqrt(SMALL_CORRECTIONS / points.shape[0])
    rows = np.concatenate([moved / np.sqrt(left.size), weight * (rigid * free[:, :, None]).reshape(-1, 6)])
    wanted = np.concatenate([-left / np.sqrt(left.size), weight * np.where(free, error, 0.0).reshape(-1)])
    frame = np.linalg.lstsq(rows, wanted, rcond=None)[0]
    correction = np.where(free, rigid @ frame - error, 0.0)
    before = np.sum(_distance_errors(position_mm, error[:, :, None], pairs) ** 2)
    after = np.sum((left + moved @ frame) ** 2)
    if after > before:
        return np.zeros(shape), np.zeros(shape[:3], dtype=bool)
    return correction.reshape(shape), compensable.copy()


def _distance_errors(position_mm: tuple[F1, F1, F1], fields_mm: F3, pairs: Pairs) -> F2:
    """Errors of the distances in trilinear fields given at the nodes, shape (nodes, 3, k); result (pairs, k)."""
    grid = fields_mm.reshape(*(p.size for p in position_mm), -1)
    ends = [trilinear(position_mm, grid, p).reshape(pairs.unit.shape[0], 3, -1) for p in (pairs.first_mm, pairs.second_mm)]
    return np.asarray(np.einsum("ni,nik->nk", pairs.unit, ends[1] - ends[0]))
