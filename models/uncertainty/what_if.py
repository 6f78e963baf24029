"""Forecast of the residual errors after a partial correction, with the solution's whole uncertainty.

A correction removes the estimate, not the truth: the uncertainty stays in the machine. With true coefficients theta, estimate t and a
correction c made from it, theta - c is normal about t - c with the whole covariance of the solution. Every figure comes from draws of theta
(GUM Supplement 1), because the largest error, the range along a diagonal and the rms are not linear, and near zero their linear
uncertainty is wrong. Before and after use the same draws, so their difference has its own uncertainty. A figure that cannot be negative is
on average larger than the figure of the mean map, because the unknown part adds to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.geometry.volume import volume_grid
from abbe.models.paths import DIAGONALS, diagonal_ends, helix_points, straight_line
from abbe.models.uncertainty.known_field import KnownField

DRAWS = 600
"""Draws that determine a standard uncertainty to 3 %."""
SEED = 20_261_122
Kind = Literal["rms", "largest", "range"]


@dataclass(frozen=True)
class ForecastFigure:
    """Definition of a figure of the deviation, such as its rms over the volume.

    ``per_unit``: k components of the deviation at m points per unit of each coefficient, shape (m, k, P). ``kind``: rms or largest length
    over the points, or (with one component) range over the points.
    """

    name: str
    kind: Kind
    per_unit: F3


@dataclass(frozen=True, slots=True)
class GainForecast:
    """A figure before and after the correction, and the gain (before minus after): mean over the draws and standard uncertainty, mm."""

    name: str
    before_mm: float
    u_before_mm: float
    after_mm: float
    u_after_mm: float
    gain_mm: float
    u_gain_mm: float


def volume_figures(known: KnownField, nodes: int = 6) -> list[ForecastFigure]:
    """Volumetric error: rms and largest length over an even grid of the strokes, best-fit rigid motion removed."""
    d = known.per_unit(volume_grid(known.machine.stroke_mm, nodes))
    return [ForecastFigure("volume_rms", "rms", d), ForecastFigure("volume_max", "largest", d)]


def expected_rms(known: KnownField, nodes: int) -> tuple[float, float]:
    """Expected rms length of the deviation over an even grid, unknown part included, and its standard uncertainty, mm.

    The squared rms is a quadratic form of a normal vector, so both figures have a closed form. They agree with ``volume_rms`` of
    `volume_figures`, which `what_if` gets by draws.
    """
    d = known.per_unit(volume_grid(known.machine.stroke_mm, nodes))
    flat = d.reshape(-1, d.shape[2])
    g = flat.T @ flat / len(d)
    spread, pull = g @ known.covariance, g @ known.coefficients
    square = float(known.coefficients @ pull + np.trace(spread))
    variance = 4.0 * float(pull @ known.covariance @ pull) + 2.0 * float(np.sum(spread * spread.T))
    if square <= 0.0:
        return 0.0, 0.0
    u = float(np.sqrt(max(variance, 0.0) / square)) / 2.0
    return float(np.sqrt(max(square - u * u, 0.0))), u


def diagonal_figures(known: KnownField, *, clearance_mm: float = 10.0, positions: int = 11) -> list[ForecastFigure]:
    """Range of the deviation along each of the four body diagonals (as in ISO 230-6).

    The diagonals end ``clearance_mm`` inside the strokes, along every axis.
    """
    box = known.machine.stroke_mm + np.array([clearance_mm, -clearance_mm])
    out = []
    for name in DIAGONALS:
        start, end = diagonal_ends(box, name)
        along = (end - start) / np.linalg.norm(end - start)
        d = known.per_unit(straight_line(start, end, positions, back=False))
        out.append(ForecastFigure(f"diagonal_{name}", "range", np.einsum("i,mip->mp", along, d)[:, None, :]))
    return out


def helix_figure(known: KnownField, centre_mm: F1, radius_mm: float, *, turns: float = 3.0, positions: int = 180) -> ForecastFigure:
    """Rms reading of a ball-bar along a helix about a cup, after a fit of centre and bar length."""
    at = helix_points(centre_mm, radius_mm, turns=turns, n=positions, law="area", axis=2)
    n = (at - centre_mm) / radius_mm
    reading = np.einsum("mi,mip->mp", n, known.per_unit(at))
    free = np.concatenate([n, np.ones((len(n), 1))], axis=1)
    left = reading - free @ np.linalg.lstsq(free, reading, rcond=None)[0]
    return ForecastFigure("helix_rms", "rms", left[:, None, :])


def what_if(
    known: KnownField, taken_off: F1, figures: Sequence[ForecastFigure], *, draws: int = DRAWS, seed: int = SEED
) -> list[GainForecast]:
    """Forecast figures of the machine without correction, and with a part of the estimate corrected.

    Parameters
    ----------
    known : KnownField
        The solution.
    taken_off : array, shape (P,)
        Coefficients of the correction: the estimate of some motions (`KnownField.estimate_of`) or mean linear errors (`KnownField.linear`).
    figures : sequence of ForecastFigure
        Quantities to forecast.
    draws, seed : int
        Monte Carlo trials; equal seeds give equal numbers.
    """
    root = known.root()
    truth = known.coefficients[:, None] + root @ np.random.default_rng(seed).standard_normal((root.shape[1], draws))
    return [_outcome(f, truth, truth - taken_off[:, None]) for f in figures]


def _outcome(figure: ForecastFigure, before: F2, after: F2) -> GainForecast:
    first, last = _sizes(figure, before), _sizes(figure, after)
    gain = first - last
    means = [float(v.mean()) for v in (first, last, gain)]
    spreads = [float(v.std(ddof=1)) for v in (first, last, gain)]
    return GainForecast(figure.name, means[0], spreads[0], means[1], spreads[1], means[2], spreads[2])


def _sizes(figure: ForecastFigure, coefficients: F2) -> F1:
    """Return the figure for each column of coefficients (P, draws), shape (draws,)."""
    m, k, p = figure.per_unit.shape
    values = (figure.per_unit.reshape(m * k, p) @ coefficients).reshape(m, k, -1)
    if figure.kind == "range":
        return np.asarray(np.ptp(values[:, 0], axis=0))
    square = np.sum(values**2, axis=1)
    return np.asarray(np.sqrt(square.mean(axis=0) if figure.kind == "rms" else square.max(axis=0)))


def check_figures(known: KnownField, cup: tuple[F1, float] | None = None) -> list[ForecastFigure]:
    """Return the figures that a check run measures or a map shows: volume, body diagonals and, given ``cup`` (centre, radius), a helix."""
    out = [*volume_figures(known), *diagonal_figures(known)]
    return out if cup is None else [*out, helix_figure(known, *cup)]
