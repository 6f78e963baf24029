"""Figures of a verification run, each with its standard uncertainty: body-diagonal range, helix rms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1
from abbe.models.solvers.observations import RunData, bar_normals, nominal_reading
from abbe.models.solvers.priors import U_WAVELENGTH

U_REPEAT_MM = 1e-4
"""Repeatability of the helix figure after mounting the ball-bar again: assumed, not measured."""


@dataclass(frozen=True)
class VerificationFigure:
    """A figure, its standard uncertainty, and its curve, mm: deviation over the position on the diagonal or the index on the helix."""

    value_mm: float
    u_mm: float
    position_mm: F1
    deviation_mm: F1


def diagonal_figure(run: RunData) -> VerificationFigure:
    """Return the range of the mean deviation (out and back) along a body diagonal, with its uncertainty (ISO 230-6 style).

    Half of (out - back) is lost motion; its scatter gives the noise. The wavelength adds an uncertainty proportional to the
    length. Readings are paired by their position on the line, so a missing reading removes only its own pair.
    """
    assert run.beam is not None
    s = np.round((run.axes_mm - run.axes_mm[0]) @ run.beam, 4)
    places = np.unique(s)
    turn = int(np.argmax(s))
    out = {float(p): float(v) for p, v in zip(s[: turn + 1], run.deviation_mm[: turn + 1], strict=True)}
    back = {float(p): float(v) for p, v in zip(s[turn + 1 :], run.deviation_mm[turn + 1 :], strict=True)}
    both = [float(p) for p in places if float(p) in out and float(p) in back]
    if len(both) < 3:
        raise ValueError(f"run {run.label}: fewer than 3 positions were measured out and back")
    mean = np.array([(out[p] + back[p]) / 2 for p in both])
    half = np.array([(out[p] - back[p]) / 2 for p in both])
    scatter = float(np.std(half, ddof=1))  # a mean of two readings has the same scatter
    length = both[-1] - both[0]
    return VerificationFigure(float(np.ptp(mean)), float(np.hypot(np.sqrt(2.0) * scatter, U_WAVELENGTH * length)), np.array(both), mean)


def helix_figure(run: RunData) -> VerificationFigure:
    """Return the rms of the ball-bar deviation after a fit of cup offset and bar length, with its uncertainty and residual curve.

    The fit removes the mounting and leaves the machine's error about this centre. The uncertainty combines the noise of the block means
    (from second differences) and `U_REPEAT_MM`.
    """
    n = bar_normals(run)
    a = np.concatenate([n, np.ones((len(n), 1))], axis=1)
    y = run.deviation_mm - nominal_reading(run)
    left = y - a @ np.linalg.lstsq(a, y, rcond=None)[0]
    rms = float(np.sqrt(np.mean(left**2)))
    second = left[2:] - 2 * left[1:-1] + left[:-2]
    noise = float(np.median(np.abs(second)) * 1.4826 / np.sqrt(6.0))
    return VerificationFigure(rms, float(np.hypot(noise / np.sqrt(len(left)), U_REPEAT_MM)), np.arange(len(left), dtype=np.float64), left)
