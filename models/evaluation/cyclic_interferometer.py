"""Cyclic error of an interferometer (periodic nonlinearity): orders 1 and 2 per fringe, from its quadrature signals or a slow linear run.

Signals with offsets, with different gains, or not in quadrature describe an ellipse; the error of their phase has a period of one fringe
(offsets) and of half a fringe (gain, quadrature). An ellipse is fitted (Heydemann, Appl. Opt. 20 (1981) 3382), robustly against single bad
samples. Uncertainties come from a jackknife over blocks of neighbouring samples, so that they hold for autocorrelated noise and for shapes
other than an ellipse.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2
from abbe.models.probability import f_above

ORDERS = (1, 2)
BLOCKS = 24
SECTORS = 12
LEAST_SECTORS = 9
"""Sectors of a fringe that must hold samples, out of `SECTORS`."""
LEAST_SAMPLES = 4 * BLOCKS
BISQUARE, ROUNDS = 4.685, 20
"""Tukey's constant, in robust standard deviations; largest number of recomputations of the weights."""
GRID: F1 = np.arange(256.0) * (2.0 * np.pi / 256.0)
TREND = 3
"""Degree of the polynomial trend that a linear run may have in addition to the cyclic error."""


@dataclass(frozen=True)
class CyclicOrder:
    """Error ``amplitude`` sin(``order`` phase + ``start_rad``), with standard uncertainties; ``p``: probability of such an error by chance.

    The amplitude has the unit of the fringe.
    """

    order: int
    amplitude: float
    u_amplitude: float
    start_rad: float
    u_start_rad: float
    p: float


@dataclass(frozen=True, eq=False)
class Ellipse:
    """Quadrature signals: x = ``offset_x`` + R cos(phase), y = ``offset_y`` + R sin(phase - ``quadrature_rad``) / ``gain``."""

    offset_x: float
    offset_y: float
    gain: float
    quadrature_rad: float
    radius: float

    def phase(self, x: F1, y: F1) -> F1:
        """Corrected phase, rad, in (-pi, pi]."""
        u, v = x - self.offset_x, (y - self.offset_y) * self.gain
        return np.asarray(np.arctan2((v + u * np.sin(self.quadrature_rad)) / np.cos(self.quadrature_rad), u))

    def signals(self, phase: F1) -> tuple[F1, F1]:
        """Signals at a phase, rad."""
        y = self.offset_y + self.radius * np.sin(phase - self.quadrature_rad) / self.gain
        return self.offset_x + self.radius * np.cos(phase), y


@dataclass(frozen=True, eq=False)
class CyclicError:
    """Cyclic error of an interferometer, in the unit of ``fringe`` (displacement per period of its signals).

    ``ellipse``: None for a linear run; ``scatter``: robust standard deviation of the residuals, relative to the radius for signals;
    ``outliers``: share of rejected samples.
    """

    orders: tuple[CyclicOrder, ...]
    fringe: float
    samples: int
    scatter: float
    outliers: float
    ellipse: Ellipse | None = None

    @property
    def u_reading(self) -> float:
        """Standard uncertainty of a reading at an unknown place in its fringe."""
        return float(np.sqrt(0.5 * sum(o.amplitude**2 for o in self.orders)))


def from_quadrature(x: F1, y: F1, fringe: float) -> CyclicError:
    """Fit an ellipse to signals x, y (n,), in the order of sampling.

    Raises
    ------
    ValueError
        Too few samples, too small a part of a fringe, or no ellipse.
    """
    ellipse, weights, left = _ellipse(x, y)
    _check(x.size, ellipse.phase(x, y))
    found = _jackknifed(x.size, lambda kept: _phase_orders(_ellipse(x[kept], y[kept])[0]))
    orders = _orders(*found, fringe / (2.0 * np.pi))
    return CyclicError(orders, fringe, x.size, _robust_sd(left), float(np.mean(weights == 0.0)), ellipse)


def from_linear_run(reading: F1, deviation: F1, fringe: float) -> CyclicError:
    """Fit waves and a smooth trend to the ``deviation`` (n,) of an interferometer's ``reading`` (n,) from a reference, both in one unit.

    Raises
    ------
    ValueError
        Too few readings, or too small a part of a fringe.
    """
    phase = 2.0 * np.pi * reading / fringe
    _check(reading.size, np.angle(np.exp(1j * phase)))
    span = max(float(np.ptp(reading)), 1e-12)
    trend = np.polynomial.legendre.legvander(2.0 * (reading - reading.min()) / span - 1.0, TREND)
    columns = np.column_stack([*(wave(k * phase) for k in ORDERS for wave in (np.sin, np.cos)), trend])
    _, weights, left = _robust(columns, deviation)
    found = _jackknifed(reading.size, lambda kept: _robust(columns[kept], deviation[kept])[0][: 2 * len(ORDERS)])
    return CyclicError(_orders(*found, 1.0), fringe, reading.size, _robust_sd(left), float(np.mean(weights == 0.0)))


def _check(samples: int, phase: F1) -> None:
    if samples < LEAST_SAMPLES:
        raise ValueError(f"{samples} samples, expected {LEAST_SAMPLES} or more")
    seen = np.unique(np.floor((phase + np.pi) / (2.0 * np.pi) * SECTORS).astype(int) % SECTORS).size
    if seen < LEAST_SECTORS:
        raise ValueError(f"the samples lie in {seen} of {SECTORS} parts of a fringe, expected {LEAST_SECTORS} or more")


def _ellipse(x: F1, y: F1) -> tuple[Ellipse, F1, F1]:
    """Ellipse, weights of the samples, and residuals of their relative radius."""
    middle = np.median(x), np.median(y)
    scale = float(np.median(np.hypot(x - middle[0], y - middle[1])))
    if not scale > 0.0:
        raise ValueError("the signals do not change")
    u, v = (x - middle[0]) / scale, (y - middle[1]) / scale
    (a, b, c, d, e), weights, left = _robust(np.column_stack([u * u, u * v, v * v, u, v]), np.ones(x.size))
    root = 4.0 * a * c - b * b
    if not (a > 0.0 and root > 0.0):
        raise ValueError("the signals describe no ellipse")
    p, q = (b * e - 2.0 * c * d) / root, (b * d - 2.0 * a * e) / root
    alpha = float(np.arcsin(b / (2.0 * np.sqrt(a * c))))
    size = (1.0 + a * p * p + b * p * q + c * q * q) / a
    radius = scale * float(np.sqrt(size) / np.cos(alpha))
    return Ellipse(float(middle[0] + scale * p), float(middle[1] + scale * q), float(np.sqrt(c / a)), alpha, radius), weights, -0.5 * left


def _phase_orders(ellipse: Ellipse) -> F1:
    """Sine and cosine coefficients of the phase error of uncorrected signals, rad, order after order."""
    x, y = ellipse.signals(GRID)
    error = np.angle(np.exp(1j * (np.arctan2(y, x) - GRID)))
    return np.array([2.0 * np.mean(error * wave(k * GRID)) for k in ORDERS for wave in (np.sin, np.cos)])


def _robust(columns: F2, values: F1) -> tuple[F1, F1, F1]:
    """Least squares with Tukey's bisquare: coefficients, weights, residuals."""
    weights = np.ones(values.size)
    coefficients: F1 = np.zeros(columns.shape[1])
    left = values
    for _ in range(ROUNDS):
        root = np.sqrt(weights)
        found = np.asarray(np.linalg.lstsq(columns * root[:, None], values * root, rcond=None)[0], dtype=np.float64)
        left = values - columns @ found
        limit = BISQUARE * max(_robust_sd(left), 1e-12)
        weights = np.where(np.abs(left) < limit, (1.0 - (left / limit) ** 2) ** 2, 0.0)
        settled = bool(np.abs(found - coefficients).max() < 1e-10 * max(float(np.abs(found).max()), 1e-30))
        coefficients = found
        if settled:
            break
    return coefficients, weights, left


def _robust_sd(values: F1) -> float:
    return float(np.median(np.abs(values)) / 0.6745)


def _jackknifed(samples: int, estimate: Callable[[NDArray[np.bool_]], F1]) -> tuple[F1, F2]:
    """Estimate from all samples, and its covariance from estimates without one block of neighbours each."""
    block = np.arange(samples) * BLOCKS // samples
    without = np.array([estimate(block != k) for k in range(BLOCKS)])
    off = without - without.mean(axis=0)
    return estimate(block >= 0), (BLOCKS - 1.0) / BLOCKS * off.T @ off


def _orders(coefficients: F1, covariance: F2, scale: float) -> tuple[CyclicOrder, ...]:
    out = []
    for i, order in enumerate(ORDERS):
        part = slice(2 * i, 2 * i + 2)
        c, v = scale * coefficients[part], scale**2 * covariance[part, part]
        size = float(np.hypot(*c))
        along = c / size if size > 0.0 else np.array([1.0, 0.0])
        across = np.array([-along[1], along[0]])
        u, u_across = (float(np.sqrt(w @ v @ w)) for w in (along, across))
        chance = float(c @ np.linalg.pinv(v) @ c) / 2.0
        p = float(f_above(chance, 2, BLOCKS - 2))
        out.append(CyclicOrder(order, size, u, float(np.arctan2(c[1], c[0])), u_across / size if size > 0.0 else float("inf"), p))
    return tuple(out)
