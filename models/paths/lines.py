"""Straight laser tests: body diagonals in sequential or plain steps (math.md 5.1), single-axis lines (ISO 230-2)."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2

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


FACES: dict[str, tuple[str, str]] = {"XY": ("pp", "np"), "YZ": ("pp", "np"), "ZX": ("pp", "np")}
"""The six face diagonals (ISO 230-6): two in each plane; ``np`` runs from large to small along the plane's first axis."""


def face_ends(box_mm: F2, plane: str, diagonal: str, share: float) -> tuple[F1, F1]:
    """Start and end of a face diagonal of a box, with the third axis standing at ``share`` of its length (0 its lower end).

    Raises
    ------
    ValueError
        Another plane or diagonal.
    """
    if plane not in FACES or diagonal not in FACES[plane]:
        raise ValueError(f"face diagonal {plane} {diagonal}: must be XY, YZ or ZX and pp or np")
    a, b = ("XYZ".index(c) for c in plane)
    third = 3 - a - b
    start, end = box_mm[:, 0].copy(), box_mm[:, 0].copy()
    start[third] = end[third] = box_mm[third, 0] + share * (box_mm[third, 1] - box_mm[third, 0])
    start[a], end[a] = box_mm[a] if diagonal == "pp" else box_mm[a, ::-1]
    end[b] = box_mm[b, 1]
    return start, end


def target_shares(n: int, offset_share: float, seed: int) -> F1:
    """Places of n targets between 0 and 1: equidistant, each moved by a pseudo-random part of the interval (ISO 230-2).

    ``offset_share``: largest offset over the interval, below 0.5 so that the order stays; the first and last move inwards.
    """
    if n < 2 or not 0.0 <= offset_share < 0.5:
        raise ValueError("targets: two or more, moved by less than half an interval")
    step = 1.0 / (n - 1)
    offset = np.random.default_rng(seed).uniform(-1.0, 1.0, n) * offset_share * step
    offset[0], offset[-1] = abs(offset[0]), -abs(offset[-1])
    return np.asarray(np.linspace(0.0, 1.0, n) + offset)


def cycles_of(out_mm: F2, cycles: int, overrun_mm: float = 0.0) -> tuple[F2, F1]:
    """Positions of a bidirectional test and the direction (+1 out, -1 back) of each: out and back, ``cycles`` times.

    With an overrun the machine goes so far beyond both ends (along the first and last leg) before it turns, so that every target is
    approached from the side that its direction names; these places are positions too. Without, the turning points stand there twice.

    Parameters
    ----------
    out_mm : array, shape (n, 3)
        The way out.

    Returns
    -------
    positions, shape (m, 3), and directions, shape (m,).
    """
    if cycles < 1 or overrun_mm < 0.0:
        raise ValueError("cycles: one or more, with an overrun of 0 or more")
    way, there = np.asarray(out_mm, dtype=np.float64), np.ones(len(out_mm))
    if overrun_mm == 0.0:
        once, sign = np.concatenate([way, way[::-1]]), np.concatenate([there, -there])
        return np.tile(once, (cycles, 1)), np.tile(sign, cycles)
    first, last = way[0] - overrun_mm * _unit(way[1] - way[0]), way[-1] + overrun_mm * _unit(way[-1] - way[-2])
    rows, signs = [first[None]], [np.ones(1)]
    for _ in range(cycles):
        rows += [way, last[None], way[::-1], first[None]]
        signs += [there, np.ones(1), -there, -np.ones(1)]
    return np.concatenate(rows), np.concatenate(signs)


def _unit(v: F1) -> F1:
    return np.asarray(v / np.linalg.norm(v))
