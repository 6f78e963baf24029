"""Covariance of predicted deviations on a full grid, without the design of every point.

By rule G a deviation is J m: the 18 error motions m, each a function of its own axis, times the levers J. On a grid the
covariance of m therefore consists of blocks of 6 x 6 that depend on one or two of the three positions: they are computed once for each pair
of lines, and a point needs only products with its levers. A rigid motion that is removed is a fourth block, which depends on no position.
A point costs some microseconds; its design of hundreds of terms times the factor of every source would cost ten times as much.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from abbe.models.arrays import F2, F3, F4
from abbe.models.geometry.bases import Term, term_values
from abbe.models.geometry.chain import design, motion_jacobian
from abbe.models.geometry.field import BLOCK, Lines, in_blocks
from abbe.models.geometry.volume import RigidFree, rigid_at, rigid_fit
from abbe.models.machine import Machine

SHORTEST = 4
"""Least number of positions of each line: the table of the two other lines must stay small compared with the results."""
Take = Callable[[slice, F4], None]


def grid_covariances(
    machine: Machine, terms: tuple[Term, ...], lines: Lines, frame: RigidFree | None, factors: Sequence[F2], take: Take
) -> None:
    """Compute the covariance of the deviation by each of several factors at every point of a grid, a stretch of points at a time.

    Parameters
    ----------
    machine : Machine
        With the tool of the prediction.
    lines : three arrays, shape (nx,), (ny,), (nz,)
        Positions of X, Y and Z, mm; points are counted with X slowest and Z fastest.
    frame : RigidFree, optional
        As in `abbe.models.geometry.volume.unit_deviation`.
    factors : sequence of S arrays, shape (len(terms), q)
        Covariances ``factor factor^T`` of the coefficients.
    take : function
        Called, by several threads at once, with a slice of point numbers and their covariances, mm^2, shape (S, points, 3, 3).
    """
    ny, nz = lines[1].size, lines[2].size
    blocks = _influences(machine, terms, lines, frame, factors)
    rows = max(1, BLOCK // (2 * nz))
    for first in range(0, ny, rows):
        strip = slice(first, min(first + rows, ny))
        tables = _tables(blocks, strip)

        def planes(of_x: slice, strip: slice = strip, tables: dict[tuple[int, int], F4] = tables) -> None:
            for i in range(of_x.start, of_x.stop):
                points = _points(lines, i, strip)
                levers = _levers(machine, points, frame).reshape(-1, nz, len(blocks), 3, 6)
                found = _covariances(levers, tables | _tables_of_x(blocks, i, strip))
                start = (i * ny + strip.start) * nz
                take(slice(start, start + len(points)), found)

        in_blocks(lines[0].size, planes, weight=(strip.stop - strip.start) * nz)


def _influences(machine: Machine, terms: tuple[Term, ...], lines: Lines, frame: RigidFree | None, factors: Sequence[F2]) -> list[list[F3]]:
    """Return the six motions of X, Y and Z along their lines, and the frame's, per unit of each input of each factor: (n, 6, q)."""
    out = []
    for a, line in enumerate(lines):
        at = np.zeros((line.size, 3))
        at[:, a] = line
        values, per_unit = term_values(terms, at, machine.stroke_mm), np.zeros((line.size, 6, len(terms)))
        for t, term in enumerate(terms):
            if term.axis == a:
                per_unit[:, term.component, t] = values[:, t]
        out.append([per_unit @ factor for factor in factors])
    if frame is not None:
        fitted = rigid_fit(frame, design(machine, terms, frame.reference_mm))
        out.append([(fitted @ factor)[None] for factor in factors])
    return out


def _points(lines: Lines, i: int, strip: slice) -> F2:
    y, z = lines[1][strip], lines[2]
    out: F2 = np.empty((y.size, z.size, 3))
    out[..., 0], out[..., 1], out[..., 2] = lines[0][i], y[:, None], z
    return out.reshape(-1, 3)


def _levers(machine: Machine, points: F2, frame: RigidFree | None) -> F4:
    """Return the deviation per unit of each block's six motions, shape (points, blocks, 3, 6)."""
    own = np.swapaxes(motion_jacobian(machine, points), 1, 2)
    return own if frame is None else np.concatenate([own, -rigid_at(points, frame.reference_mm)[:, None]], axis=1)


def _tables(blocks: list[list[F3]], strip: slice) -> dict[tuple[int, int], F4]:
    """Return the covariances between blocks that do not depend on X, shape (rows or 1, nz or 1, 6, 6 S), by the numbers of the blocks."""
    y, z, *rest = [block[strip] for block in blocks[1]], *blocks[2:]
    out = {(1, 1): _own(y)[:, None], (1, 2): _pair(y, z), (2, 2): _own(z)[None]}
    if rest:
        out |= {(1, 3): _pair(y, rest[0]), (2, 3): np.swapaxes(_pair(z, rest[0]), 0, 1), (3, 3): _own(rest[0])[None]}
    return out


def _tables_of_x(blocks: list[list[F3]], i: int, strip: slice) -> dict[tuple[int, int], F4]:
    """Return the covariances, as `_tables` does, with the blocks that depend on X, at one position of X."""
    x = [block[i : i + 1] for block in blocks[0]]
    out = {(0, 0): _own(x)[None], (0, 1): np.swapaxes(_pair(x, [block[strip] for block in blocks[1]]), 0, 1), (0, 2): _pair(x, blocks[2])}
    return out | {(0, 3): _pair(x, blocks[3])} if len(blocks) > 3 else out


def _pair(left: list[F3], right: list[F3]) -> F4:
    """Return the covariance of two blocks at all pairs of their positions, shape (n, m, 6, 6 S): columns by factor."""
    n, m = len(left[0]), len(right[0])
    parts = [a.reshape(6 * n, -1) @ b.reshape(6 * m, -1).T for a, b in zip(left, right, strict=True)]
    return np.concatenate([np.swapaxes(part.reshape(n, 6, m, 6), 1, 2) for part in parts], axis=3)


def _own(block: list[F3]) -> F3:
    """Return half the covariance of one block at each of its positions, shape (n, 6, 6 S); the sum with its transpose is the covariance."""
    return np.concatenate([0.5 * one @ np.swapaxes(one, 1, 2) for one in block], axis=2)


def _covariances(levers: F4, tables: dict[tuple[int, int], F4]) -> F4:
    """Return the covariances J C J^T of the points, shape (S, points, 3, 3); ``levers``: (rows, nz, blocks, 3, 6)."""
    rows, nz, count = levers.shape[:3]
    size = next(iter(tables.values())).shape[3] // 6
    total: F3 = np.zeros((rows, nz, 3 * size, 3))
    for b in range(count):
        carried = sum(levers[:, :, a] @ tables[a, b] for a in range(b + 1))
        total += np.reshape(carried, (rows, nz, 3 * size, 6)) @ np.swapaxes(levers[:, :, b], 2, 3)
    found = np.moveaxis(total.reshape(rows * nz, 3, size, 3), 2, 0)
    whole = found + np.swapaxes(found, 2, 3)
    variance = np.einsum("...ii->...i", whole)
    np.maximum(variance, 0.0, out=variance)  # what a frame cancels may leave a rounding error below zero
    return np.asarray(whole)
