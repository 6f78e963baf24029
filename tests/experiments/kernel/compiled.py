"""`kernel.scattered` as a compiled loop, on one processor core or, when asked for, on all.

The one file that knows numba (extra ``fast``). Without it, importing this file is an ImportError, and `tests.experiments.kernel.fast` takes
numpy.

On one core there is no state and no thread library: any number of threads may be in this function at once (Python's lock is free
meanwhile), and a forked process may go on calling them. Sharing a call among the cores needs one of numba's threading layers; what that
costs in safety is said at ``all_cores`` and in decision 0009.

A point costs three rows of a table and about 40 multiply-adds. Each row holds, four numbers wide (X, Y, Z and a zero), the translation and
what one mm of each travel adds; the four are one vector register, so the loop does a point's three directions at once.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numba
import numpy as np
from numba import prange
from numba.core.compiler_lock import global_compiler_lock
from numpy.typing import ArrayLike

from abbe.models.arrays import F1, F2
from tests.experiments.kernel import kernel
from tests.experiments.kernel.table_machine import Segments, TableMachine

BLOCK = 4096
"""Points that one core takes at a time."""


_U = np.uint64
_FIRST, _SECOND, _THIRD = 32, 24, 16
"""Row lengths by place in the chain, slopes behind offsets: the translation and 3, 2, 1 travels, 4 numbers each, twice."""


def scattered(tables: TableMachine, axes_mm: ArrayLike, out: F2 | None = None, *, all_cores: bool = False) -> F2:
    """First-order deviation at any positions (rule G, math.md 2), as `tests.experiments.kernel.kernel.scattered` has it.

    Agrees with it to rounding (sums are in another order, multiply-adds are rounded once).

    Parameters
    ----------
    tables : TableMachine
        Error motions in mm and rad, ISO 230-1 signs.
    axes_mm : array, shape (n, 3)
        Commanded X, Y, Z. Outside the tables their end values hold (levers and squareness go on). A NaN or an infinite position makes its
        own row NaN, and no other.
    out : array, shape (n, 3), optional
        Where to write; float64, C order, apart from ``axes_mm``.
    all_cores : bool
        Share the points among `threads` cores. A process forked after such a call must not ask for it again: GNU OpenMP ends it.

    Returns
    -------
    array, shape (n, 3)
        Actual minus nominal, tool relative to workpiece, in the directions of X, Y, Z, mm; ``out`` if given.

    Raises
    ------
    ValueError
        A shape or the kind of ``out`` is wrong.
    """
    axes, result = kernel.prepared(axes_mm, out)
    seg = tables.segments
    limits = np.array([[seg.first_mm[a], seg.length_mm[a], seg.cells_per_mm[a]] for a in seg.order])
    loop = _shared_loop() if all_cores and _shareable() else _compiled
    loop(axes.reshape(-1), *_rows(seg), limits, np.array(seg.order, dtype=np.int64), result.reshape(-1))
    return result


def threads() -> int:
    """Number of processor cores that ``all_cores`` uses: all that the process may run on, unless NUMBA_NUM_THREADS says otherwise.

    1 where numba has no threading layer that several threads may enter at once. Asking starts that layer.
    """
    return int(numba.get_num_threads()) if _shareable() else 1


def _shareable() -> bool:
    """Whether numba's threading layer bears calls from several threads; its own workqueue aborts the process on the second."""
    numba.get_num_threads()  # chooses the layer
    return numba.threading_layer() in {"omp", "tbb"}


def _rows(seg: Segments) -> list[F1]:
    """Tables of the carriages from the workpiece to the tool, one row per node, rows behind each other."""
    rows = []
    for k, axis in enumerate(seg.order):
        parts = []
        for values, constant in ((seg.offset[axis], 1.0), (seg.slope[axis], 0.0)):
            part = np.zeros((values.shape[1], 4 - k, 4))
            part[:, 0, :3] = values[:3].T
            for i, travel in enumerate(seg.order[k:]):
                if i or seg.own[axis]:
                    part[:, 1 + i, :3] = np.cross(values[3:].T, np.eye(3)[travel])
            part[:, 1, :3] += constant * seg.square[axis]
            parts.append(part.reshape(len(part), -1))
        rows.append(np.concatenate(parts, axis=1).reshape(-1))
    return rows


def _locate(x: Any, limits: Any, width: Any) -> Any:
    """Start of a position's row, and the distance from the first node, held at the ends; NaN for a position that is not finite."""
    first, length, cells = limits
    along = x - first
    along = 0.0 if along < 0.0 else along
    along = length if along > length else along
    cell = np.int32(0.0 if np.isnan(along) else along * cells)
    return _U(cell) * _U(width), along + (x - x)


def _lane(a: Any, b: Any, c: Any, places: Any, travels: Any, n: Any) -> Any:
    """One direction: carriages a, b, c from the workpiece, each with the start of its row and the distance; travels in the same order."""
    (i, r), (j, s), (k, t) = places
    i, j, k = i + n, j + n, k + n
    move = (a[i] + r * a[i + _U(16)]) + (b[j] + s * b[j + _U(12)]) + (c[k] + t * c[k + _U(8)])
    first = a[i + _U(4)] + r * a[i + _U(20)]
    second = (a[i + _U(8)] + r * a[i + _U(24)]) + (b[j + _U(4)] + s * b[j + _U(16)])
    third = (a[i + _U(12)] + r * a[i + _U(28)]) + (b[j + _U(8)] + s * b[j + _U(20)]) + (c[k + _U(4)] + t * c[k + _U(12)])
    return move + first * travels[0] + second * travels[1] + third * travels[2]


def _point(axes: Any, a: Any, b: Any, c: Any, limits: Any, order: Any, at: Any) -> Any:
    """The three directions of one point, and the fourth number of the register (zero)."""
    travels = axes[at + order[0]], axes[at + order[1]], axes[at + order[2]]
    places = _find(travels[0], limits[0], _FIRST), _find(travels[1], limits[1], _SECOND), _find(travels[2], limits[2], _THIRD)
    return (
        _sum(a, b, c, places, travels, _U(0)),
        _sum(a, b, c, places, travels, _U(1)),
        _sum(a, b, c, places, travels, _U(2)),
        _sum(a, b, c, places, travels, _U(3)),
    )


def _chunk(axes: Any, tables: Any, limits: Any, order: Any, start: Any, end: Any, out: Any) -> None:
    """Points ``start`` to ``end``. Four numbers are written at once; the fourth lands on the next point, which is written after it."""
    a, b, c = tables
    # Numbers instead of array elements: the compiler cannot know that writing `out` leaves them alone.
    ends = (
        (limits[0, 0], limits[0, 1], limits[0, 2]),
        (limits[1, 0], limits[1, 1], limits[1, 2]),
        (limits[2, 0], limits[2, 1], limits[2, 2]),
    )
    places = _U(order[0]), _U(order[1]), _U(order[2])
    for q in range(start, end - 1):
        at = _U(q) * _U(3)
        dx, dy, dz, pad = _deviation(axes, a, b, c, ends, places, at)
        out[at] = dx
        out[at + _U(1)] = dy
        out[at + _U(2)] = dz
        out[at + _U(3)] = pad
    at = _U(end - 1) * _U(3)
    dx, dy, dz, pad = _deviation(axes, a, b, c, ends, places, at)
    out[at] = dx
    out[at + _U(1)] = dy
    out[at + _U(2)] = dz


def _loop(axes: Any, a: Any, b: Any, c: Any, limits: Any, order: Any, out: Any) -> None:
    """All points on one core."""
    if axes.size:
        _part(axes, (a, b, c), limits, order, 0, axes.size // 3, out)


# Functions of their own: numba's cache knows a function by its place and signature, not by the options it was compiled with.
def _loop_shared(axes: Any, a: Any, b: Any, c: Any, limits: Any, order: Any, out: Any) -> None:
    """All points, in chunks that the cores share."""
    n = axes.size // 3
    for block in prange((n + BLOCK - 1) // BLOCK):
        _part(axes, (a, b, c), limits, order, block * BLOCK, min(n, (block + 1) * BLOCK), out)


def _compile(function: Any, signature: Any, *, shared: bool) -> Any:
    """A loop as machine code, kept beside Python's own byte code where that can be written, so that only the first process waits.

    numba leaves LLVM's joining of neighbouring operations into vector registers off by default; it is what makes the loop over points twice
    as fast. The switch is read while compiling and belongs to the whole process, so it is put back, with numba's own lock held meanwhile.
    """
    options = {"parallel": shared, "nogil": True, "fastmath": {"contract"}, "error_model": "numpy"}
    with global_compiler_lock:
        before = numba.config.SLP_VECTORIZE
        numba.config.SLP_VECTORIZE = 1
        try:
            return numba.njit(signature, cache=True, **options)(function)
        except RuntimeError:  # nowhere to keep it
            return numba.njit(signature, **options)(function)
        finally:
            numba.config.SLP_VECTORIZE = before


@cache
def _shared_loop() -> Any:
    """Compiled when first asked for: merely loading it starts the threading layer."""
    return _compile(_loop_shared, _LOOP, shared=True)


_inlined = numba.njit(forceinline=True, fastmath={"contract"})
_find, _sum, _deviation, _part = (_inlined(f) for f in (_locate, _lane, _point, _chunk))
_READ = numba.types.Array(numba.float64, 1, "C", readonly=True)
_LOOP = numba.void(_READ, _READ, _READ, _READ, numba.float64[:, ::1], numba.int64[::1], numba.float64[::1])
_compiled = _compile(_loop, _LOOP, shared=False)
