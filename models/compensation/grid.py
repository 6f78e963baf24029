"""3-D grid of corrections with trilinear interpolation. Unlike one-axis tables, a grid also corrects the effect of angles at a lever.

The corrections do not contain the best-fit rigid motion over the grid, which changes no distance between two points of a part. An added
constant keeps the reference node in place, because a controller's reference point must not move.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2, F3, F4
from abbe.models.compensation.distances import Pairs, random_pairs
from abbe.models.compensation.tables import check_unit, grid_positions
from abbe.models.geometry.chain import design
from abbe.models.geometry.volume import RigidFree, rigid_design

if TYPE_CHECKING:
    from abbe.models.solvers.joint import JointSolution
    from abbe.models.uncertainty.inputs import StatedInputs
    from abbe.models.uncertainty.scales import Scales
    from abbe.models.uncertainty.sources import ErrorSources

FIT_SAMPLES = 5
"""Samples per cell for the fit of a function; with these, the fit of a parabola is within 2 % of the continuous fit."""


def cells(nodes_mm: F1, position_mm: F1) -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.intp]], F1]:
    """Return the index of the cell of each position, and the position within the cell, clipped to 0 .. 1."""
    index = np.clip(np.searchsorted(nodes_mm, position_mm, side="right") - 1, 0, nodes_mm.size - 2)
    share = (position_mm - nodes_mm[index]) / (nodes_mm[index + 1] - nodes_mm[index])
    return index, np.clip(share, 0.0, 1.0)


def trilinear(nodes_mm: tuple[F1, F1, F1], values: F4, axes_mm: F2) -> F2:
    """Interpolate trilinearly in a grid.

    Parameters
    ----------
    nodes_mm : three arrays
        Increasing positions of the nodes on X, Y, Z.
    values : array, shape (nx, ny, nz, m)
    axes_mm : array, shape (n, 3)
        Positions; a position outside the grid gets the nearest value on its surface.

    Returns
    -------
    array, shape (n, m)
    """
    index, share = zip(*(cells(nodes_mm[a], axes_mm[:, a]) for a in range(3)), strict=True)
    out = np.zeros((axes_mm.shape[0], values.shape[3]))
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod([share[a] if corner[a] else 1.0 - share[a] for a in range(3)], axis=0)
        out += weight[:, None] * values[index[0] + corner[0], index[1] + corner[1], index[2] + corner[2]]
    return out


def fit_positions(nodes_mm: F1) -> F1:
    """Return the positions at which a function of one axis is sampled for a fit: the middles of `FIT_SAMPLES` equal parts of each cell."""
    part = (np.arange(FIT_SAMPLES) + 0.5) / FIT_SAMPLES
    return np.asarray((nodes_mm[:-1, None] + np.diff(nodes_mm)[:, None] * part).ravel())


def fit_operator(nodes_mm: F1) -> F2:
    """Return the matrix from values at `fit_positions` to node values of the least-squares polyline, shape (nodes, samples).

    A polyline through points of a curve lies on one side of the curve, h^2 f''/8 off in the middle of a cell of length h. The least-squares
    polyline crosses the curve and leaves about 0.4 times this rms error for a parabola (0.6 times for distances in a volume).
    """
    x = fit_positions(nodes_mm)
    index, share = cells(nodes_mm, x)
    hat = np.zeros((x.size, nodes_mm.size))
    rows = np.arange(x.size)
    hat[rows, index], hat[rows, index + 1] = 1.0 - share, share
    return np.asarray(np.linalg.pinv(hat))


# Nodes whose deviation is smaller than its uncertainty are not compensated. This section treats the border between them and the others.
#
# Rule: all nodes that are not compensated have the same correction, so that no distance between them changes. The compensated nodes have
# minus the deviation plus the rigid motion that minimises the errors of distances across the border. In the cells between, the correction
# changes linearly.
#
# Guarantee: by the identified field, the sum of squares of the distance errors (fixed pairs over the whole volume) is never larger than
# without correction. As the unknown part of the field is the same in both cases, this holds for the expected error too. If a mask breaks
# the guarantee, for example because it cuts a smooth error into pieces, nothing is compensated.


SMALL_CORRECTIONS = 1e-2
"""Weight of small corrections relative to correct distances; it matters only if the mask has few nodes."""


def blend(position_mm: tuple[F1, F1, F1], error_mm: F4, compensable: NDArray[np.bool_]) -> tuple[F4, NDArray[np.bool_]]:
    """Compute the corrections at the nodes for a mask of nodes to compensate.

    Parameters
    ----------
    position_mm : three arrays
        Nodes of X, Y, Z.
    error_mm : array, shape (nx, ny, nz, 3)
        Deviation at the nodes, in any frame.
    compensable : array of bool, shape (nx, ny, nz)
        Nodes to compensate.

    Returns
    -------
    correction_mm : array, shape (nx, ny, nz, 3)
        Zero at nodes that are not compensated.
    compensated : array of bool, shape (nx, ny, nz)
        ``compensable``, or all False if the correction would make distances worse.
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
    """Return the errors of distances, shape (pairs, k), in k trilinear fields that are given at the nodes, shape (nodes, 3, k)."""
    grid = fields_mm.reshape(*(p.size for p in position_mm), -1)
    ends = [trilinear(position_mm, grid, p).reshape(pairs.unit.shape[0], 3, -1) for p in (pairs.first_mm, pairs.second_mm)]
    return np.asarray(np.einsum("ni,nik->nk", pairs.unit, ends[1] - ends[0]))


Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class GridTable:
    """Corrections at the nodes of a grid, to be added to the command.

    Attributes
    ----------
    position_mm : three arrays
        Nodes of X, Y, Z.
    correction_mm : array, shape (nx, ny, nz, 3)
        Zero at the reference node.
    u_mm : array, shape (nx, ny, nz, 3)
        Standard uncertainty of the deviation at each node from all sources (`abbe.models.uncertainty.prediction`), in the frame without
        rigid motion over the grid. `compensable_nodes` uses the same values.
    compensated : array of bool, shape (nx, ny, nz)
        False: the deviation there is not known well enough. All these nodes have the same correction, so that no distance between two of
        them changes.
    reference : (int, int, int)
        Index of the node that stays in place.
    """

    position_mm: tuple[F1, F1, F1]
    correction_mm: F4
    u_mm: F4
    compensated: Mask
    reference: tuple[int, int, int]

    def correction_at(self, axes_mm: F2) -> F2:
        """Return the correction at commanded positions, mm, shape (n, 3): trilinear, constant beyond the grid."""
        return trilinear(self.position_mm, self.correction_mm, axes_mm)


def nodes_mm(position_mm: tuple[F1, F1, F1]) -> F2:
    """Return all nodes of a grid, X slowest, shape (nx ny nz, 3)."""
    return np.stack(np.meshgrid(*position_mm, indexing="ij"), axis=-1).reshape(-1, 3)


def node_design(solution: JointSolution, position_mm: tuple[F1, F1, F1], *, fitted: bool = True) -> F3:
    """Return the node values of the best trilinear field per unit of each coefficient of the solution, shape (nodes, 3, terms).

    ``fitted``: fit by least squares over the volume of the grid; False: take the deviation at the nodes themselves. A term is at most
    linear in the other two axes (rule G), where trilinear interpolation is exact. So a fit along the term's own axis is the fit over the
    volume (tests/models/compensation/test_tables_grid.py).
    """
    counts = tuple(p.size for p in position_mm)
    out: F3 = np.empty((int(np.prod(counts)), 3, len(solution.terms)))
    for a in range(3):
        mine = [i for i, t in enumerate(solution.terms) if t.axis == a]
        chosen = tuple(solution.terms[i] for i in mine)
        if not fitted:
            out[:, :, mine] = design(solution.machine, chosen, nodes_mm(position_mm))
            continue
        sampled = tuple(fit_positions(p) if k == a else p for k, p in enumerate(position_mm))
        values = design(solution.machine, chosen, nodes_mm((sampled[0], sampled[1], sampled[2])))
        cube = values.reshape(*(p.size for p in sampled), 3, len(mine))
        out[:, :, mine] = np.moveaxis(np.tensordot(fit_operator(position_mm[a]), cube, (1, a)), 0, a).reshape(-1, 3, len(mine))
    return out


def grid_table(
    solution: JointSolution,
    counts: tuple[int, int, int],
    *,
    compensable: Mask | None = None,
    reference: tuple[int, int, int] = (0, 0, 0),
    fitted: bool = True,
    sources: ErrorSources | None = None,
) -> GridTable:
    """Make the best 3-D grid of corrections for the identified machine.

    Parameters
    ----------
    counts : (int, int, int)
        Nodes of X, Y, Z.
    compensable : array of bool, shape ``counts``, optional
        Nodes to compensate, e.g. from `compensable_nodes`; default: all.
    reference : (int, int, int)
        Index of the node that stays in place.
    fitted : bool
        Fit the interpolant to the field instead of sampling the field at the nodes; a fit leaves about 0.6 of the rms error between nodes.
    sources : ErrorSources, optional
        Sources of uncertainty for ``u_mm``; default: ``error_sources(solution)``.

    Raises
    ------
    ValueError
        Fewer than 2 nodes on an axis, a mask of another shape, or a reference outside the grid.
    """
    from abbe.models.uncertainty.prediction import predict_deviation
    from abbe.models.uncertainty.sources import error_sources

    position = grid_positions(solution.machine, counts)
    keep = np.ones(counts, dtype=bool) if compensable is None else np.asarray(compensable, dtype=bool)
    if keep.shape != counts:
        raise ValueError(f"grid table: the mask has shape {keep.shape}, expected {counts}")
    if not all(0 <= r < n for r, n in zip(reference, counts, strict=True)):
        raise ValueError(f"grid table: reference node {reference} is outside the grid of {counts} nodes")
    error = (node_design(solution, position, fitted=fitted) @ solution.coefficients).reshape(*counts, 3)
    correction, done = blend(position, error, keep)
    points = nodes_mm(position)
    u = predict_deviation(sources or error_sources(solution), points, frame=RigidFree(points)).u_mm.reshape(*counts, 3)
    return GridTable(position, correction - correction[reference], u, done, reference)


def compensable_nodes(
    solution: JointSolution,
    counts: tuple[int, int, int],
    *,
    inputs: StatedInputs | None = None,
    k: float | None = None,
    scales: Scales | None = None,
) -> Mask:
    """Return the nodes at which the deviation exceeds its expanded uncertainty from all sources, shape ``counts``.

    The deviation is taken without rigid motion over the grid. ``k``: coverage factor, default for 95 %. Nodes are also excluded where an
    error that no reading shows may exceed the deviation (`abbe.models.uncertainty.prediction`). ``scales``: scale errors to leave out of
    the uncertainty and of this hidden error.
    """
    from abbe.models.uncertainty.prediction import compensable_mask, predict_deviation, unobserved_mm
    from abbe.models.uncertainty.scales import scale_projection, without_scales
    from abbe.models.uncertainty.sources import error_sources

    points = nodes_mm(grid_positions(solution.machine, counts))
    frame = RigidFree(points)
    sources, projection = error_sources(solution, inputs), None
    if scales is not None:
        sources, projection = without_scales(sources, scales), scale_projection(solution.machine, solution.terms, scales)
    prediction = predict_deviation(sources, points, frame=frame)
    observed = unobserved_mm(solution, points, frame, projection=projection) <= np.linalg.norm(prediction.deviation_mm, axis=1)
    return np.asarray((compensable_mask(prediction, k=k).points & observed).reshape(counts), dtype=bool)


def quantise_grid(table: GridTable, lsb_mm: float) -> GridTable:
    """Return the grid as the controller stores it: every correction rounded to the controller's unit.

    Raises
    ------
    ValueError
        The unit is not a positive number.
    """
    check_unit(lsb_mm)
    return replace(table, correction_mm=np.round(table.correction_mm / lsb_mm) * lsb_mm)
