"""Stick-slip of an axis that creeps at one speed in all runs: scatter along the axis that no single frequency explains.

Where the speed never changes, nothing shows that the scatter falls with speed. But a vibration has one frequency, while the teeth of a
stick-slip differ in length, so that their frequencies spread. If the readings scatter along the axis without the band of their strongest
frequency, the axis sticks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2
from abbe.models.discovery.instrument_noise import CREEP_MM_S
from abbe.models.discovery.variance.spectrum import BAND, GATES_MM_S, RoughnessFit, height, roughness_of
from abbe.models.effects.path import Path

ONE_SPEED = 1.3
"""An axis creeps at one speed if the fastest tenth of its readings begins below `CREEP_MM_S` and below `ONE_SPEED` times the end of the
slowest tenth."""
IN_RUNS = 0.75
"""Least share of the runs that move the axis in which the scatter shows: a disturbance in one run is no stick-slip."""
SINGULAR = 1e-6


def creep_speed(axis: int, paths: Sequence[Path]) -> float | None:
    """Return the speed of an axis, mm/s, if it creeps at the same speed in all runs that move it; else None."""
    speeds = [np.abs(p.at.v_mm_s[:, axis]) for p in paths if _moves(p, axis)]
    if not speeds:
        return None
    low, high = (float(np.quantile(np.concatenate(speeds), s)) for s in (0.1, 0.9))
    return 0.5 * (low + high) if high < CREEP_MM_S and high < ONE_SPEED * low else None


def _moves(path: Path, axis: int) -> bool:
    return bool(np.ptp(path.at.q_mm[:, axis]) > 0)


@dataclass(frozen=True)
class AxisScatter:
    """Scatter along an axis at any speed. ``gain``: gain in log likelihood; ``height_mm``: half height of teeth that scatter as much;
    ``u_mm``: its standard uncertainty.
    """

    gain: float
    height_mm: float
    u_mm: float


def scatter_along(axis: int, paths: tuple[Path, ...], rest: tuple[F1, ...], sigma_mm: tuple[float, ...]) -> AxisScatter:
    """Find scatter along an axis, beside scatter along the other axes.

    Parameters
    ----------
    rest : whitened residuals by run, shape (n,) each, high-passed (`abbe.models.discovery.variance.spectrum.fast`); exact zeros mark
        readings that are left out.
    sigma_mm : noise of one reading of each run.

    Returns
    -------
    AxisScatter
        The gain is that of the squared residuals, but at most that of the squared second differences, which leave out deviations that
        neighbours share. It is 0 if less than `IN_RUNS` of the runs show the scatter in both.
    """
    run = np.repeat(np.arange(len(paths)), [p.n for p in paths])
    values, moving = np.concatenate(rest), np.array([_moves(p, axis) for p in paths])
    read = values != 0.0
    look = np.concatenate([p.look**2 for p in paths]) / np.square(sigma_mm)[run, None]
    across, along = np.delete(look, axis, axis=1)[read], (look[:, axis] * moving[run])[read]
    fits = [RoughnessFit.of(s[read], across) for s in (np.concatenate([roughness_of(r) for r in rest]), values**2)]
    (rough, _, _), (raw, variance, u) = (f.gain(along) for f in fits)
    shown = [np.bincount(run[read], f.by_reading(along)[0], len(paths))[moving] > 0.0 for f in fits]
    gain = min(rough, raw) if np.mean(shown[0] & shown[1]) >= IN_RUNS else 0.0
    return AxisScatter(gain, *height(variance, u))


def without_band(frequency_hz: float, axis: int, path: Path, rest: F1) -> F1:
    """Project a wave along an axis with a slowly changing amplitude (`band`) out of the residuals of a run; exact zeros stay."""
    base = band(frequency_hz, axis, path, rest != 0.0)
    return np.asarray(rest - base @ (base.T @ rest))


def band(frequency_hz: float, axis: int, path: Path, read: NDArray[np.bool_]) -> F2:
    """Return an orthonormal basis, shape (n, k), of waves along an axis whose amplitude changes slowly (`BAND`), zero where not ``read``.

    A run too short for that has none (k = 0).
    """
    t = path.at.t_s - path.at.t_s[0]
    if path.n < 2 * (2 * BAND + 1) or t[-1] <= 0.0:
        return np.zeros((path.n, 0))
    cycles = frequency_hz * t[:, None] + np.outer(t / t[-1], np.arange(-BAND, BAND + 1))
    waves = np.concatenate([np.cos(2.0 * np.pi * cycles), np.sin(2.0 * np.pi * cycles)], axis=1) * path.look[:, axis, None]
    base, size, _ = np.linalg.svd(waves * read[:, None], full_matrices=False)
    return np.asarray(base[:, size > SINGULAR * size[0]] * read[:, None])  # rounding leaves 1e-17 there


def at_standstill(height: float, u: float, v_mm_s: float) -> tuple[float, float, float]:
    """Convert the half height of teeth at one speed; return half height at standstill, its standard uncertainty, and v_c, mm/s.

    An axis that sticks at a speed has a v_c above it; all gates (`GATES_MM_S`) above it are equally likely. v_c gives the same teeth at
    this speed. ``height``, ``u``: any unit of length.
    """
    ratios = np.array([np.exp((v_mm_s / v_c) ** 2) for v_c in GATES_MM_S if v_c > v_mm_s] or [np.e])
    ratio = float(ratios.mean())
    spread = float(ratios.std()) if ratios.size > 1 else ratio
    return ratio * height, float(np.hypot(ratio * u, spread * height)), v_mm_s / float(np.sqrt(np.log(ratio)))
