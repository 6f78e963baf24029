"""Deviation of a `TableMachine` at very many points, with numpy alone: rule G (math.md 2) as `chain.deviation_mm` has it, only faster.

`scattered` takes any points. It works block by block, so that everything in between stays in the processor's cache and memory use does not
grow with the number of points; one look-up index per axis serves all its motions. `grid` takes a full grid: every term of rule G depends on
X times something of Y and Z, so the whole is one product of two small matrices.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from abbe.models.arrays import F1, F2
from abbe.models.machine import lever_masks
from tests.experiments.kernel.table_machine import Segments, TableMachine

BLOCK = 16384
"""Points worked on at a time: ten rows of 128 kB; smaller costs calls, larger falls out of the cache (measured)."""

_TILE = (32, 1000)
"""Rows and columns per product: with 8 in between fewer than 2**18 multiplications, from which on OpenBLAS shares them out."""

Product = Callable[[F2, F2, F2, int], None]

_GRID_CHUNK = 1 << 17
"""Nodes of the Y-Z plane, and of each axis, worked on at a time in `grid`: what it needs beside positions and result stays below 80 MB."""


def scattered(tables: TableMachine, axes_mm: ArrayLike, out: F2 | None = None, *, block: int = BLOCK) -> F2:
    """First-order deviation at any positions.

    Parameters
    ----------
    tables : TableMachine
    axes_mm : array, shape (n, 3)
        Commanded positions. Outside the tables their end values hold (levers and squareness go on).
        A NaN or an infinite position makes its own row NaN, and no other.
    out : array, shape (n, 3), optional
        Where to write; float64, C order, apart from ``axes_mm``.
    block : int
        Points worked on at a time.

    Returns
    -------
    array, shape (n, 3)
        Actual minus nominal, tool relative to workpiece, mm; ``out`` if given.

    Raises
    ------
    ValueError
        A shape or a kind of ``out`` is wrong, or ``block`` is below 1.
    """
    axes, result = prepared(axes_mm, out)
    if block < 1:
        raise ValueError(f"kernel: block = {block}, expected 1 or more")
    n = axes.shape[0]
    room, index = np.empty((9, min(block, n))), np.empty(min(block, n), dtype=np.intp)
    with np.errstate(invalid="ignore", over="ignore"):  # NaN as an index is any number, and the look-up clips it
        for start in range(0, n, block):
            rows = slice(start, min(start + block, n))
            m = rows.stop - start
            some = axes[rows]
            if not np.isfinite(some.sum()):  # cheap: true for nearly every block, and where it is not the next line is merely not needed
                some = some + (some - some)
            _block(tables.segments, some, room[:, :m], index[:m])
            result[rows] = room[:3, :m].T
    return result


def _block(seg: Segments, axes: F2, room: F2, index: NDArray[np.intp]) -> None:
    """Leave the deviation in rows 0..2 of ``room``; rows 3..5 sum the angles from the workpiece to the carriage reached."""
    total, position, along, work = room[:6], room[6], room[7], room[8]
    total.fill(0.0)
    for axis in seg.order:
        position[:] = axes[:, axis]
        np.subtract(position, seg.first_mm[axis], out=along)
        np.maximum(along, 0.0, out=along)
        np.minimum(along, seg.length_mm[axis], out=along)
        np.multiply(along, seg.cells_per_mm[axis], out=work)
        np.copyto(index, work, casting="unsafe")
        if not seg.own[axis]:
            _turn(total, position, axis, seg.square[axis], work)
        for c in seg.needed[axis]:
            np.take(seg.slope[axis][c], index, out=work, mode="clip")
            work *= along
            total[c] += work
            np.take(seg.offset[axis][c], index, out=work, mode="clip")
            total[c] += work
        if seg.own[axis]:
            _turn(total, position, axis, seg.square[axis], work)


def _turn(total: F2, position: F1, axis: int, square: F1, work: F1) -> None:
    """Add (angles so far) x travel of one axis, and its squareness."""
    u, v = (axis + 1) % 3, (axis + 2) % 3
    for component, angle, sign in ((u, 3 + v, 1.0), (v, 3 + u, -1.0)):
        if square[component]:
            np.add(total[angle], sign * square[component], out=work)
            work *= position
        else:
            np.multiply(total[angle], position, out=work)
        (np.add if sign > 0 else np.subtract)(total[component], work, out=total[component])


def grid(
    tables: TableMachine,
    x_mm: ArrayLike,
    y_mm: ArrayLike,
    z_mm: ArrayLike,
    out: NDArray[np.float64] | None = None,
    *,
    product: Product | None = None,
) -> NDArray[np.float64]:
    """First-order deviation on the full grid of given positions of X, Y and Z, which need be neither even nor sorted.

    Parameters
    ----------
    tables : TableMachine
    x_mm, y_mm, z_mm : arrays, shape (nx,), (ny,), (nz,)
        Commanded positions, treated as in `scattered`.
    out : array, shape (nx, ny, nz, 3), optional
        Where to write; float64, C order.
    product : function of (a, b, out, first), optional
        Puts the matrix product of a (nx, 8) and b (8, m) into the m columns of out that begin at first; by default BLAS on one core.

    Returns
    -------
    array, shape (nx, ny, nz, 3)
        Actual minus nominal, tool relative to workpiece, mm; ``out`` if given.

    Raises
    ------
    ValueError
        A shape or the kind of ``out`` is wrong.
    """
    axes = [np.asarray(v, dtype=np.float64) for v in (x_mm, y_mm, z_mm)]
    if any(v.ndim != 1 for v in axes):
        raise ValueError(f"kernel: grid positions must have shape (n,), got {', '.join(str(v.shape) for v in axes)}")
    nx, ny, nz = (v.size for v in axes)
    result = writable((nx, ny, nz, 3), out)
    if 0 in (nx, ny, nz):
        return result
    seg, mask, flat = tables.segments, lever_masks(tables.machine.chain), result.reshape(nx, -1)
    for z in _pieces(nz, _GRID_CHUNK):
        at_z, of_z = _along_axis(seg, mask, 2, axes[2][z])
        for y in _pieces(ny, max(1, _GRID_CHUNK // nz)):
            at_y, of_y = _along_axis(seg, mask, 1, axes[1][y])
            of_yz = _plane(mask, at_y, at_z, of_y, of_z).reshape(8, -1)
            for x in _pieces(nx, _GRID_CHUNK):
                at_x, values = _along_axis(seg, mask, 0, axes[0][x])
                of_x = np.concatenate([np.ones((1, at_x.size)), at_x[None], values]).T
                (product or _product)(of_x, of_yz, flat[x], (y.start * nz + z.start) * 3)
    return result


def _pieces(n: int, most: int) -> list[slice]:
    """``n`` rows in as few pieces as need be, of even size."""
    size = -(-n // -(-n // most))
    return [slice(start, min(start + size, n)) for start in range(0, n, size)]


def _product(a: F2, b: F2, out: F2, first: int) -> None:
    """In tiles that BLAS leaves on one core: shared, the whole is at best twice as fast and ten times slower when another core is busy."""
    for i in range(0, len(a), _TILE[0]):
        for j in range(0, b.shape[1], _TILE[1]):
            tile = b[:, j : j + _TILE[1]]
            np.matmul(a[i : i + _TILE[0]], tile, out=out[i : i + _TILE[0], first + j : first + j + tile.shape[1]])


def _along_axis(seg: Segments, mask: F2, axis: int, position_mm: F1) -> tuple[F1, F2]:
    """Positions, NaN where not finite, and what depends on one axis alone: translations (own lever and squareness included), angles."""
    with np.errstate(invalid="ignore"):
        position_mm = position_mm + (position_mm - position_mm)
    along = np.clip(position_mm - seg.first_mm[axis], 0.0, seg.length_mm[axis])
    with np.errstate(invalid="ignore"):
        cell = (along * seg.cells_per_mm[axis]).astype(np.intp)
    values: F2 = np.take(seg.slope[axis], cell, axis=1, mode="clip") * along + np.take(seg.offset[axis], cell, axis=1, mode="clip")
    own = mask[axis, axis] * _cross_unit(values[3:], axis) + seg.square[axis][:, None]
    values[:3] += own * position_mm
    return position_mm, values


def _plane(mask: F2, y_mm: F1, z_mm: F1, of_y: F2, of_z: F2) -> NDArray[np.float64]:
    """What stands beside 1, x, EX EY EZ and EA EB EC of X, shape (8, ny, nz, 3)."""
    out = np.zeros((8, y_mm.size, z_mm.size, 3))
    out[0] = of_y[:3].T[:, None] + of_z[:3].T[None]
    out[0] += mask[1, 2] * _cross_unit(of_y[3:], 2).T[:, None] * z_mm[None, :, None]
    out[0] += mask[2, 1] * _cross_unit(of_z[3:], 1).T[None] * y_mm[:, None, None]
    out[1] = mask[1, 0] * _cross_unit(of_y[3:], 0).T[:, None] + mask[2, 0] * _cross_unit(of_z[3:], 0).T[None]
    out[2:5] = np.eye(3)[:, None, None]
    lever_y, lever_z = mask[0, 1] * y_mm[:, None], mask[0, 2] * z_mm[None]
    out[5, :, :, 1], out[5, :, :, 2] = -lever_z, lever_y
    out[6, :, :, 0], out[7, :, :, 0] = lever_z, -lever_y
    return out


def _cross_unit(vectors: F2, axis: int) -> F2:
    """Vectors in columns, shape (3, n), times (cross product) the unit vector of an axis."""
    u, v = (axis + 1) % 3, (axis + 2) % 3
    out = np.zeros_like(vectors)
    out[u], out[v] = vectors[v], -vectors[u]
    return out


def prepared(axes_mm: ArrayLike, out: F2 | None) -> tuple[F2, F2]:
    """Positions as float64 (n, 3) in C order, and a place for the result; ValueError when they do not fit each other."""
    axes: F2 = np.ascontiguousarray(axes_mm, dtype=np.float64)
    if axes.ndim != 2 or axes.shape[1] != 3:
        raise ValueError(f"kernel: axes_mm must have shape (n, 3), got {np.shape(axes_mm)}")
    result = writable(axes.shape, out)
    if out is not None and np.may_share_memory(axes, out):
        raise ValueError("kernel: out must be apart from axes_mm")
    return axes, result


def writable(shape: tuple[int, ...], out: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """``out``, checked, or a new array; ValueError when ``out`` does not have the shape, is not float64 in C order, or is read-only."""
    if out is None:
        return np.empty(shape)
    if not isinstance(out, np.ndarray):
        raise ValueError(f"kernel: out must be a writable float64 array in C order of shape {shape}, got {type(out).__name__}")
    if out.shape != shape or out.dtype != np.float64 or not (out.flags.c_contiguous and out.flags.writeable):
        raise ValueError(f"kernel: out must be a writable float64 array in C order of shape {shape}, got {out.dtype} {out.shape}")
    return out
