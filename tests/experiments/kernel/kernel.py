"""Deviation of a `TableMachine` at very many points, with numpy alone: rule G (math.md 2) as `chain.deviation_mm` has it, only faster.

It works block by block, so that everything in between stays in the processor's cache and memory use does not grow with the number of
points; one look-up index per axis serves all its motions. A full grid is the product's own (`abbe.models.geometry.field`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from abbe.models.arrays import F1, F2
from tests.experiments.kernel.table_machine import Segments, TableMachine

BLOCK = 16384
"""Points worked on at a time: ten rows of 128 kB; smaller costs calls, larger falls out of the cache (measured)."""


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
