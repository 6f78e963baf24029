"""Straight laser tests: body diagonals in sequential or plain steps (math.md 5.1), single-axis lines (ISO 230-2)."""

from __future__ import annotations

import numpy as np

from models.arrays import F1, F2

DIAGONALS: dict[str, tuple[int, int, int]] = {"ppp": (1, 1, 1), "npp": (-1, 1, 1), "pnp": (1, -1, 1), "ppn": (1, 1, -1)}


def diagonal_ends(box_mm: F2, diagonal: str) -> tuple[F1, F1]:
    """Start and end of a body diagonal of a box (shape (3, 2)); ``npp`` runs from large to small X."""
    signs = DIAGONALS[diagonal]
    start = np.array([box_mm[a, 0] if s > 0 else box_mm[a, 1] for a, s in enumerate(signs)])
    end = np.array([box_mm[a, 1] if s > 0 else box_mm[a, 0] for a, s in enumerate(signs)])
    return start, end


def step_diagonal(start_mm: F1, end_mm: F1, steps: int, order: str = "XYZ", *, back: bool = True) -> F2:
    """Positions of a sequential step-diagonal test: one axis moves at a time, in ``order``, ``steps`` times.

    Out in the given order and, if ``back``, back in the reverse order with the turning point recorded twice (run-format.md 3).

    Returns
    -------
    array, shape (3 steps + 1, 3), or twice that with ``back``: one position per record, the start first.
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
    """Positions of a plain line test: ``n`` equidistant positions out and, if ``back``, the same back (turning point twice)."""
    out = np.linspace(start_mm, end_mm, n)
    return np.concatenate([out, out[::-1]]) if back else out
