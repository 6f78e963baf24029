"""Noise of an instrument as its own repeats tell it, before any model is fitted."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.solvers.observations import RunData, nominal_reading

DEFAULT_SIGMA_MM = {"bar": 4e-4, "laser": 3e-4}
"""Standard uncertainty of one reading where nothing was repeated: the makers' figures for good instruments."""
RESOLUTION_MM = 5e-5
"""Smallest standard uncertainty of an averaged value: no display and no encoder shows less."""
FEWEST_REPEATS = 8
FOURTH: F1 = np.array([1.0, -4.0, 6.0, -4.0, 1.0])


def repeat_noise_mm(runs: tuple[RunData, ...], kind: str) -> float | None:
    """Standard deviation of one raw reading of an instrument from what was measured more than once, mm; None: nothing was.

    Ball-bar: fourth differences of neighbours on a dense path, which smooth motions do not reach. Laser: readings at equal positions of one
    run with lost motion and drift taken out; where every position was visited once, fourth differences too. Median over the readings, so
    that outliers do not count.
    """
    found = [v for run in runs if run.kind == kind for v in (_of_run(run),) if v.size]
    values = np.concatenate(found) if found else np.zeros(0)
    if values.size < FEWEST_REPEATS:
        return None
    return max(float(np.median(np.abs(values)) / 0.6744897501960817), 0.1 * RESOLUTION_MM)


def _of_run(run: RunData) -> F1:
    """Differences of repeats, each scaled to the standard deviation of one raw reading."""
    y = run.deviation_mm - nominal_reading(run)
    if run.kind == "laser":
        pairs = same_place(run.axes_mm)
        if len(pairs) >= FEWEST_REPEATS:
            return _pairs(run, y, pairs)
    return _fourth(run, y)


def same_place(axes_mm: F2) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """Pairs of indices of readings at the same commanded position, each reading with its next visit, shape (m, 2)."""
    _, place = np.unique(np.round(axes_mm, 4), axis=0, return_inverse=True)
    order = np.argsort(place, kind="stable")
    equal = np.flatnonzero(np.diff(place[order]) == 0)
    return np.stack([order[equal], order[equal + 1]], axis=1)


def _pairs(run: RunData, y: F1, pairs: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> F1:
    i, j = pairs.T
    difference = y[j] - y[i]
    known = np.column_stack([run.sign[j] - run.sign[i], run.t_s[j] - run.t_s[i], np.ones(len(pairs))])
    scale = np.linalg.norm(known, axis=0)
    known = known[:, scale > 0] / scale[scale > 0]
    fit, _, rank, _ = np.linalg.lstsq(known, difference, rcond=None)
    left = (difference - known @ fit) * np.sqrt(len(pairs) / max(len(pairs) - int(rank), 1))
    return np.asarray(left / np.sqrt(1.0 / run.weight_n[i] + 1.0 / run.weight_n[j]))


def _fourth(run: RunData, y: F1) -> F1:
    if y.size < FEWEST_REPEATS:
        return np.zeros(0)
    windows = np.lib.stride_tricks.sliding_window_view
    same = (np.ptp(windows(run.sign, 5, axis=0), axis=-1) == 0).all(axis=-1)
    spread = np.sqrt(windows(1.0 / run.weight_n, 5) @ FOURTH**2)
    return np.asarray((windows(y, 5) @ FOURTH)[same] / spread[same])
