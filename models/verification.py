"""Figures of a verification run, each with its standard uncertainty: body-diagonal range, helix rms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1
from abbe.models.solvers.observations import RunData, bar_normals, nominal_reading
from abbe.models.solvers.priors import U_WAVELENGTH

U_REPEAT_MM = 1e-4
"""Repeatability of a re-mounted ball-bar's shape reading, an assumption until repeats are measured."""


@dataclass(frozen=True)
class VerificationFigure:
    """A measured figure, mm, its standard uncertainty, and the curve it comes from (position along the test, deviation; mm)."""

    value_mm: float
    u_mm: float
    position_mm: F1
    deviation_mm: F1


def diagonal_figure(run: RunData) -> VerificationFigure:
    """Range of the mean of out and back along a body diagonal, with its uncertainty (ISO 230-6 style).

    The scatter of half the difference out - back about its mean (which is lost motion) gives the noise; the wavelength adds its share of
    the length. Positions are matched by their place on the line, so a missing reading removes only its own pair.
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
    scatter = float(np.std(half, ddof=1))  # of a mean of two readings, like the mean itself
    length = both[-1] - both[0]
    return VerificationFigure(float(np.ptp(mean)), float(np.hypot(np.sqrt(2.0) * scatter, U_WAVELENGTH * length)), np.array(both), mean)


def helix_figure(run: RunData) -> VerificationFigure:
    """Rms of the bar deviation after the cup offset and the bar length are fitted away; abscissa: path index.

    What is left is the machine's error about this centre, not the mounting. Uncertainty: the noise of the block means (second
    differences) through the rms, and `U_REPEAT_MM`.
    """
    n = bar_normals(run)
    a = np.concatenate([n, np.ones((len(n), 1))], axis=1)
    y = run.deviation_mm - nominal_reading(run)
    left = y - a @ np.linalg.lstsq(a, y, rcond=None)[0]
    rms = float(np.sqrt(np.mean(left**2)))
    second = left[2:] - 2 * left[1:-1] + left[:-2]
    noise = float(np.median(np.abs(second)) * 1.4826 / np.sqrt(6.0))
    return VerificationFigure(rms, float(np.hypot(noise / np.sqrt(len(left)), U_REPEAT_MM)), np.arange(len(left), dtype=np.float64), left)
