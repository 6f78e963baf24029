"""Straight laser tests: body diagonals in sequential or plain steps (math.md 5.1), single-axis lines (ISO 230-2)."""

from __future__ import annotations

import numpy as np

from models.arrays import F1, F2

DIAGONALS: dict[str, tuple[int, int, int]] = {"ppp": (1, 1, 1), "npp": (-1, 1, 1), "pnp": (1, -1, 1), "ppn": (1, 1, -1)}


def diagonal_ends(box_mm: F2, diagonal: str) -> tuple[F1, F1]:
    """Start and end of a body diagonal of a box: ``npp`` runs from large to small X (Wang's names, math.md 5.1).

    Parameters
    ----------
    box_mm : array, shape (3, 2)
        Lower and upper end of X, Y, Z, any frame.
    diagonal : str
        ppp, npp, pnp or ppn.

    Returns
    -------
    two arrays, shape (3,), mm, in the frame of the box.

    Raises
    ------
    ValueError
        Another diagonal, or no (3, 2) box.
    """
    if diagonal not in DIAGONALS:
        raise ValueError(f"diagonal {diagonal!r}: must be one of {', '.join(DIAGONALS)}")
    if np.shape(box_mm) != (3, 2):
        raise ValueError(f"diagonal {diagonal}: the box must have shape (3, 2), got {np.shape(box_mm)}")
    signs = DIAGONALS[diagonal]
    start = np.array([box_mm[a, 0] if s > 0 else box_mm[a, 1] for a, s in enumerate(signs)])
    end = np.array([box_mm[a, 1] if s > 0 else box_mm[a, 0] for a, s in enumerate(signs)])
    return start, end


def step_diagonal(start_mm: F1, end_mm: F1, steps: int, order: str = "XYZ", *, back: bool = True) -> F2:
    """Positions of a sequential step-diagonal test: one axis moves at a time, in ``order``, ``steps`` times.

    Out in the given order and, if ``back``, back in the reverse order with the turning point recorded twice (run-format.md 3). Source:
    Wang's sequential step diagonal (math.md 5.1), which the paper steps X, Y, Z.

    Parameters
    ----------
    start_mm, end_mm : array, shape (3,)
        Ends of the diagonal, e.g. of `diagonal_ends`.
    steps : int
        Steps per axis.
    order : str
        X, Y and Z once each.
    back : bool
        Whether the way back belongs to the test.

    Returns
    -------
    array, shape (3 steps + 1, 3), or twice as many rows with ``back``, mm: one position per record, the start first.

    Raises
    ------
    ValueError
        ``order`` does not name every axis once, or ``steps`` < 1.
    """
    if sorted(order) != ["X", "Y", "Z"] or steps < 1:
        raise ValueError(f"step diagonal: order {order!r} must name X, Y, Z once each and steps be 1 or more")
    inc = (np.asarray(end_mm) - np.asarray(start_mm)) / steps
    counts = np.zeros((3 * steps + 1, 3))
    for k in range(3 * steps):
        counts[k + 1] = counts[k]
        counts[k + 1, "XYZ".index(order[k % 3])] += 1
    out: F2 = np.asarray(start_mm) + counts * inc
    out[-1] = end_mm
    return np.concatenate([out, out[::-1]]) if back else out


def straight_line(start_mm: F1, end_mm: F1, n: int, *, back: bool = True) -> F2:
    """Positions of a plain line test: ``n`` equidistant positions out and, if ``back``, the same back (turning point twice; ISO 230-2).

    Parameters
    ----------
    start_mm, end_mm : array, shape (3,)
        First and last position.
    n : int
        Positions, both ends included.
    back : bool
        Whether the way back belongs to the test.

    Returns
    -------
    array, shape (n, 3), or (2 n, 3) with ``back``, mm.

    Raises
    ------
    ValueError
        Fewer than two positions.
    """
    if n < 2:
        raise ValueError(f"line: {n} positions, a line needs 2 or more")
    out = np.linspace(start_mm, end_mm, n)
    return np.concatenate([out, out[::-1]]) if back else out
