"""Repeatability of the machine from what was measured more than once (ISO 230-2 idea, in the readings of a campaign)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.solvers.observations import RunData

FEWEST = 8
"""Degrees of freedom below which no figure is given: it would be known to worse than 25 %."""


@dataclass(frozen=True, slots=True)
class RepeatabilityEstimate:
    """Scatter of equal approaches.

    ``machine_mm``: standard deviation of the machine along the instrument, sensor noise taken out; ``reading_mm``: of the readings as they
    are; ``dof``: degrees of freedom of the latter.
    """

    machine_mm: float
    reading_mm: float
    dof: float


def machine_repeatability(runs: tuple[RunData, ...], kind: str, sensor_mm: float) -> RepeatabilityEstimate | None:
    """Pooled standard deviation of readings of one instrument at equal positions, approached in equal directions, in one set-up.

    Zero and drift of every run are taken out first. None: too little was repeated.

    Parameters
    ----------
    runs : tuple of RunData
    kind : "bar" | "laser"
    sensor_mm : float
        Standard uncertainty of the instrument in one raw reading, from its maker or from readings at standstill.

    Raises
    ------
    ValueError
        ``sensor_mm`` is negative.
    """
    if sensor_mm < 0:
        raise ValueError(f"repeatability: sensor noise {sensor_mm} mm is negative")
    chosen = [r for r in runs if r.kind == kind]
    if not chosen:
        return None
    y = np.concatenate([r.deviation_mm for r in chosen])
    place, effects = _places(chosen), _run_effects(chosen)
    count = np.bincount(place)
    repeated = count[place] > 1
    y, effects, place = y[repeated], effects[repeated], place[repeated]
    groups = int((count > 1).sum())
    left = _within(y[:, None], place)[:, 0]
    known = _within(effects, place)
    fit, _, rank, _ = np.linalg.lstsq(known, left, rcond=None) if y.size else (np.zeros(known.shape[1]), 0, 0, 0)
    dof = y.size - groups - int(rank)
    if dof < FEWEST:
        return None
    variance = float(np.sum((left - known @ fit) ** 2) / dof)
    averaged = np.concatenate([1.0 / r.weight_n for r in chosen])[repeated]
    machine = variance - sensor_mm**2 * float(averaged.mean())
    return RepeatabilityEstimate(float(np.sqrt(max(machine, 0.0))), float(np.sqrt(variance)), float(dof))


def _places(runs: list[RunData]) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """Number of the place of every reading: set-up, commanded position (to 0.1 um) and directions of approach."""
    setups = {name: i for i, name in enumerate(dict.fromkeys(r.setup for r in runs))}
    parts = [np.column_stack([np.full(len(r.axes_mm), setups[r.setup]), np.round(r.axes_mm, 4), np.sign(r.sign)]) for r in runs]
    return np.asarray(np.unique(np.concatenate(parts), axis=0, return_inverse=True)[1]).reshape(-1)


def _run_effects(runs: list[RunData]) -> F2:
    """Zero and drift of every run, shape (n, 2 runs)."""
    out = np.zeros((sum(r.deviation_mm.size for r in runs), 2 * len(runs)))
    at = 0
    for i, r in enumerate(runs):
        n = r.deviation_mm.size
        span = float(np.ptp(r.t_s)) or 1.0
        out[at : at + n, 2 * i], out[at : at + n, 2 * i + 1] = 1.0, (r.t_s - r.t_s[0]) / span
        at += n
    return out


def _within(values: F2, place: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> F2:
    """Values minus the mean of their place."""
    count: F1 = np.maximum(np.bincount(place), 1).astype(np.float64) if place.size else np.zeros(0)
    out = np.array(values)
    for k in range(values.shape[1]):
        out[:, k] -= (np.bincount(place, values[:, k]) / count)[place] if place.size else 0.0
    return out
