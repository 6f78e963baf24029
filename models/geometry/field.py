"""Deviation by rule G at many points, fast and without loss of digits: a grid is a product of matrices, and blocks fit into the cache.

Every error motion depends on the position of its own axis only. On a full grid rule G is therefore a sum of eight terms, each a value along
X times a value in the Y-Z plane: the functions are evaluated on three lines, and the rest is one product of matrices, (nx, 8) by
(8, 3 ny nz). Points in any other order are processed in blocks. Two threads share the work in both cases
(docs/decisions/0047-a-map-is-numpy.md).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context

import numpy as np
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2, F3, F4
from abbe.models.geometry.chain import deviation_mm
from abbe.models.geometry.rotation import cross
from abbe.models.machine import Machine, lever_masks, levers_mm

BLOCK = 4096
"""Points in one block: 18 motions of them are 0.6 MB."""
SHARED = 65_536
"""Least number of points for which the cores share the blocks; with fewer points, starting threads costs more than it saves."""
CORES = 2
"""Number of threads for many points. More would only wait for memory; on a single core the second costs little."""
LEAST = 512
"""Least number of points for which it is worth testing whether they form a grid."""
TILE = (20, 1500)
"""Rows and columns of one product, among the fastest of 20 shapes tried: times 8, fewer than the 2**18 multiplications from which on
OpenBLAS starts threads of its own."""
TILES = 2
"""Columns of tiles in one call of numpy. Threads wait for each other between calls, so one call takes long, about 0.1 ms."""
COMPARED = 250_000
"""Points that one call compares with a grid."""

Motions = Callable[[F2], F3]
Lines = tuple[F1, F1, F1]


def field_mm(machine: Machine, motions: Motions, axes_mm: F2) -> F2:
    """Return the deviation of the machine's functional point at many positions, as `abbe.models.geometry.chain.deviation_mm` does.

    Parameters
    ----------
    motions : function
        Error motions at positions, shape (n, 3) -> (n, 3 axes, 6), mm and rad, squareness included. The motions of an axis must depend on
        the position of this axis only, and several threads may call the function at once.
    axes_mm : array, shape (n, 3)
        Commanded positions. A full grid, X slowest, is recognised.

    Returns
    -------
    array, shape (n, 3)
        Actual minus nominal, tool relative to workpiece, mm. Grid and blocks agree to rounding, about 1e-15 mm.

    Raises
    ------
    ValueError
        The shape is wrong.
    """
    found = _on_grid(machine, motions, axes_mm)
    if found is not None:
        return found
    out: F2 = np.empty((len(axes_mm), 3))

    def block(rows: slice) -> None:
        out[rows] = deviation_mm(machine, axes_mm[rows], motions(axes_mm[rows]))

    in_blocks(len(axes_mm), block)
    return out


def in_blocks(count: int, work: Callable[[slice], None], *, weight: int = 1) -> None:
    """Call ``work`` for slices that cover ``count`` rows, in any order; several threads do it if there are many rows.

    ``weight``: points in one row. A slice has `BLOCK` points or, if a row has more, one row.
    """
    size = max(1, BLOCK // weight)
    blocks = [slice(start, min(start + size, count)) for start in range(0, count, size)]
    rest = iter(blocks)

    def run() -> None:
        for one in rest:  # the threads share the iterator, so a core that is busy otherwise takes fewer
            work(one)

    helpers = min(CORES, len(blocks)) - 1 if count * weight >= SHARED else 0
    if helpers < 1:
        run()
        return
    with ThreadPoolExecutor(helpers, thread_name_prefix="abbe-field") as pool:
        others = [pool.submit(copy_context().run, run) for _ in range(helpers)]  # numpy's error state belongs to the context
        run()
    for one in others:
        one.result()


def grid_lines(axes_mm: F2) -> Lines | None:
    """Return the positions of X, Y and Z if the points, shape (n, 3), are exactly a full grid with X slowest and Z fastest, else None."""
    lines = _edges(axes_mm)
    if lines is None:
        return None
    count, same = _comparison(axes_mm, lines)
    return lines if _in_parts(count, same, len(axes_mm)) else None


def _on_grid(machine: Machine, motions: Motions, axes_mm: F2) -> F2 | None:
    """Return `field_mm` on a full grid; None for other points, for which the computation stops at the first difference from a grid.

    Comparison and computation share the threads, so these are started once and do not wait for each other between the two tasks.
    """
    lines = _edges(axes_mm)
    if lines is None:
        return None
    (compared, same), (computed, fill, out) = _comparison(axes_mm, lines), _product(machine, lines, line_motions(motions, lines))

    def part(k: int) -> bool:
        return same(k) if k < compared else fill(k - compared)

    return out.reshape(-1, 3) if _in_parts(compared + computed, part, 2 * len(axes_mm)) else None


def _in_parts(count: int, work: Callable[[int], bool], points: int) -> bool:
    """Call ``work`` for ``count`` parts of equal size, shared by threads, until one returns False; return whether none did."""
    failed: list[int] = []

    def some(parts: slice) -> None:
        for k in range(parts.start, parts.stop):
            if failed or not work(k):
                failed.append(k)
                return

    in_blocks(count, some, weight=max(BLOCK, -(-points // count)))
    return not failed


def _edges(axes_mm: F2) -> Lines | None:
    """Return the lines of the only full grid that the points may form, taken from three of its edges; None if they cannot form a grid."""
    count = len(axes_mm)
    if count < LEAST or axes_mm.shape[1:] != (3,):
        return None
    nz = _first_change(axes_mm[:, 1])
    ny = _first_change(axes_mm[::nz, 0]) if nz else 0
    if min(nz, ny) < 2 or count % (nz * ny):
        return None
    grid = np.asarray(axes_mm).reshape(-1, ny, nz, 3)
    return grid[:, 0, 0, 0].copy(), grid[0, :, 0, 1].copy(), grid[0, 0, :, 2].copy()


def _comparison(axes_mm: F2, lines: Lines) -> tuple[int, Callable[[int], bool]]:
    """Return the number of parts of the points, and the function that compares one part with the grid of the lines."""
    nx, ny, nz = (line.size for line in lines)
    grid, planes = np.asarray(axes_mm).reshape(nx, ny * nz, 3), max(1, COMPARED // (ny * nz))
    first = np.empty((ny, nz, 3))
    first[..., 0], first[..., 1], first[..., 2] = lines[0][0], lines[1][:, None], lines[2]

    def same(k: int) -> bool:
        some = slice(k * planes, (k + 1) * planes)
        x = lines[0][some, None]
        if not (grid[some, :, 0] == x).all():
            return False
        # Every Y and Z as in the first plane, and X only where it is the first: counting is faster than looking at every third value.
        equal = ny * nz * (2 * len(x) + np.count_nonzero(x == lines[0][0]))
        return bool(np.count_nonzero(grid[some] == first.reshape(-1, 3)) == equal)

    return -(-nx // planes), same


def line_motions(motions: Motions, lines: Lines) -> tuple[F2, F2, F2]:
    """Return the six motions of X, Y and Z along their lines, shape (n_axis, 6) each, from one call of the function."""
    at: F2 = np.empty((max(line.size for line in lines), 3))
    for a, line in enumerate(lines):
        at[: line.size, a], at[line.size :, a] = line, line[-1]
    values = motions(at)
    x, y, z = (values[: line.size, a] for a, line in enumerate(lines))
    return x, y, z


def _product(machine: Machine, lines: Lines, motions: tuple[F2, F2, F2]) -> tuple[int, Callable[[int], bool], F4]:
    """Return the number of parts, the function that computes one part (True), and the array that the parts fill, (nx, ny, nz, 3), mm.

    ``motions``: EX EY EZ (mm, squareness included) and EA EB EC (rad) of each carriage along its line, shape (n_axis, 6). The lines need
    be neither even nor sorted.
    """
    nx, ny, nz = (line.size for line in lines)
    out: F4 = np.empty((nx, ny, nz, 3))
    moved = [_own(machine, a, lines[a], motions[a]) for a in range(3)]
    of_x = np.concatenate([np.ones((nx, 1)), lines[0][:, None], moved[0], motions[0][:, 3:]], axis=1)
    of_yz = _plane(lever_masks(machine.chain), lines, moved, motions).reshape(8, -1)
    flat, width = out.reshape(nx, -1), TILES * TILE[1]

    def fill(k: int) -> bool:
        columns = slice(k * width, (k + 1) * width)
        _multiply(of_x, of_yz[:, columns], flat[:, columns])
        return True

    return -(-flat.shape[1] // width), fill, out


def _multiply(a: F2, b: F2, out: F2) -> None:
    """Write the product of two matrices into ``out``, tile by tile, with one call of numpy for all tiles of a size."""
    for rows, height in _cuts(len(a), TILE[0]):
        for columns, width in _cuts(b.shape[1], TILE[1]):
            left = a[rows].reshape(1, -1, height, a.shape[1])
            right = b[:, columns].reshape(len(b), -1, 1, width).transpose(1, 2, 0, 3)
            np.matmul(left, right, out=out[rows, columns].reshape(left.shape[1], height, -1, width).transpose(2, 0, 1, 3))


def _cuts(size: int, step: int) -> Iterator[tuple[slice, int]]:
    """Yield the part of a length that whole steps fill, with the step, and the rest, with its length."""
    whole = size - size % step
    if whole:
        yield slice(0, whole), step
    if whole < size:
        yield slice(whole, size), size - whole


def _own(machine: Machine, axis: int, line_mm: F1, motions: F2) -> F2:
    """Return the part of a carriage that depends only on its own position, shape (n, 3): translation, and rotation of its constant arm."""
    at = np.zeros((line_mm.size, 3))
    at[:, axis] = line_mm
    return np.asarray(motions[:, :3] + cross(motions[:, 3:], levers_mm(machine, at)[:, axis]))


def _plane(mask: F3, lines: Lines, moved: list[F2], motions: tuple[F2, F2, F2]) -> NDArray[np.float64]:
    """Return the factors of 1, x, EX EY EZ and EA EB EC of X as functions of the Y-Z plane, shape (8, ny, nz, 3)."""
    (_, y, z), unit = lines, np.eye(3)
    y_z, y_x, z_y, z_x = (mask[a, b] * cross(motions[a][:, 3:], unit[b]) for a, b in ((1, 2), (1, 0), (2, 1), (2, 0)))
    out = np.zeros((8, y.size, z.size, 3))
    for c in range(3):  # by component: numpy is slow where the last axis has three values
        out[0, ..., c] = np.add.outer(moved[1][:, c], moved[2][:, c]) + np.outer(y_z[:, c], z) + np.outer(y, z_y[:, c])
        out[1, ..., c] = np.add.outer(y_x[:, c], z_x[:, c])
        out[2 + c, ..., c] = 1.0
    lever_y, lever_z = mask[0, 1] * y[:, None], mask[0, 2] * z[None]
    out[5, ..., 1], out[5, ..., 2] = -lever_z, lever_y
    out[6, ..., 0], out[7, ..., 0] = lever_z, -lever_y
    return out


def _first_change(values: F1) -> int:
    """Return the index of the first value that differs from the one at index 0, or the number of values."""
    for size in (LEAST, values.size):
        differs = values[:size] != values[0]
        if differs.any():
            return int(np.argmax(differs))
    return int(values.size)
