"""Side from which the axis of a positioning test approached a place with two rows: it may have overrun and come back (ISO 230-2).

Rows state where the axis stood, not how it got there. An axis at one place with ``direction`` +1 and then -1 either never moved, or overran
the place and came back between the rows.
"""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.geometry.chain import REST_MM
from abbe.service.domain.run import Run

BEYOND_MM = 5.0
"""Assumed overrun beyond a place: more than any lost motion."""
NEAR_MM = 0.05
"""Positions closer than this are the same place."""
FEWEST = 3
"""Places approached from both sides that are needed to estimate their difference."""


def with_reversals(run: Run, q_mm: F2) -> tuple[F2, np.ndarray[tuple[int], np.dtype[np.intp]]]:
    """Insert the reversals that the rows of a ``laser_linear`` run omit; other tests are returned unchanged.

    Parameters
    ----------
    run : Run
        As measured.
    q_mm : array, shape (n, 3)
        Its positions.

    Returns
    -------
    path, rows
        Positions with the reversals, shape (m, 3), and the index in it of every row, shape (n,).
    """
    rows = np.arange(len(q_mm))
    if run.test != "laser_linear" or not np.isfinite(q_mm).all() or run.laser.end_mm is None:
        return q_mm, rows
    moved = np.abs(np.diff(q_mm, axis=0)).max(axis=1, initial=0.0) > REST_MM
    way = np.sign(run.columns.direction)
    turned = np.flatnonzero(~moved & (way[1:] * way[:-1] < 0)) + 1
    if not turned.size:
        return q_mm, rows
    if not moved.any():
        turned = np.concatenate([[0], turned])
    elif not _went_beyond(run, q_mm, way, turned):
        return q_mm, rows
    beyond = q_mm[turned] - BEYOND_MM * way[turned, None] * _along(run)
    return np.insert(q_mm, turned, beyond, axis=0), rows + np.searchsorted(turned, rows, side="right")


def _along(run: Run) -> F1:
    """Unit vector from start to end of a test."""
    way = run.laser.span_mm
    return np.asarray(way / max(float(np.linalg.norm(way)), 1e-12))


def _went_beyond(run: Run, q_mm: F2, way: F1, turned: np.ndarray[tuple[int], np.dtype[np.intp]]) -> bool:
    """Whether the two readings at a reversal differ like readings from opposite sides at the other places, rather than like repeats."""
    if run.is_sealed:
        return False
    y = run.columns.readings_mm
    good = np.isfinite(y) & run.columns.valid
    pairs = turned[good[turned] & good[turned - 1]]
    good[np.concatenate([turned, turned - 1])] = False
    place = np.round(q_mm @ _along(run) / NEAR_MM)
    sides = [[y[good & (place == p) & (way == s)] for s in (1, -1)] for p in np.unique(place[good])]
    differ = np.array([a.mean() - b.mean() for a, b in sides if a.size and b.size])
    if differ.size < FEWEST or not pairs.size:
        return False
    jump = way[pairs] * (y[pairs] - y[pairs - 1])
    return bool(np.median(np.abs(jump - np.median(differ))) < np.median(np.abs(jump)))
