"""Error motions of machines nobody here made: the shapes of the practice set's families, drawn at random.

Sizes follow the practice set: rms of its open truths, second differences of their motions, and how much of its circles and diagonals is
left above the 4th, 8th and 16th harmonic. A draw gives the 18 curves of a machine; positioning and angles start at zero, straightness has
no slope (docs/explanation/conventions.md).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from scipy.interpolate import CubicSpline

from tests.experiments.calibration.kinematics import Curve, F

Rng = np.random.Generator
POSITIONING, STRAIGHTNESS, ANGLE = 0, 1, 2


@dataclass(frozen=True)
class Sizes:
    """Standard deviations over a population.

    Slope of positioning, µm/m, and of angles, µrad over the stroke; amplitude of the shape of positioning, straightness, µm, angle, µrad.
    """

    scale: float
    angle_slope: float
    shape: tuple[float, float, float]


Shape = Callable[[Rng, float, float], Curve]
"""Draw one curve: random numbers, length of the stroke, mm, amplitude."""


def smooth(rng: Rng, length_mm: float, size: float) -> Curve:
    """A Gaussian process, squared exponential, with a length of 0.2 to 0.5 of the stroke."""
    u = np.linspace(0.0, 1.0, 61)
    reach = rng.uniform(0.2, 0.5)
    cov = np.exp(-0.5 * ((u[:, None] - u[None]) / reach) ** 2) + 1e-9 * np.eye(u.size)
    return CubicSpline(u * length_mm, size * np.linalg.cholesky(cov) @ rng.standard_normal(u.size))


def polynomial(rng: Rng, length_mm: float, size: float) -> Curve:
    """Legendre polynomials of orders 2 to 6: a solver with these orders can have it exactly."""
    c = np.array([0.0, 0.0, *(size * rng.standard_normal(5) / np.arange(2, 7))])
    return lambda x: legendre.legval(2.0 * x / length_mm - 1.0, c)


def fading(rng: Rng, length_mm: float, size: float) -> Curve:
    """Legendre polynomials of orders 2 to 9 that fade as order to the power of -1.5, and nothing above."""
    k = np.arange(2, 10)
    c = np.array([0.0, 0.0, *(size * rng.standard_normal(k.size) / (k / 2.0) ** 1.5)])
    return lambda x: legendre.legval(2.0 * x / length_mm - 1.0, c)


def stepped(rng: Rng, length_mm: float, size: float) -> Curve:
    """A smooth shape, and jumps where segments of 40 to 120 mm of a scale or a rail meet."""
    base = smooth(rng, length_mm, 0.6 * size)
    ends = np.cumsum(rng.uniform(40.0, 120.0, int(length_mm / 40.0)))
    levels = 0.6 * size * rng.standard_normal(ends.size + 1)
    return lambda x: base(x) + levels[np.searchsorted(ends, x)]


def kinked(rng: Rng, length_mm: float, size: float) -> Curve:
    """A little smooth shape, kinks, and cusps where rails are joined."""
    base = smooth(rng, length_mm, 0.4 * size)
    at = rng.uniform(0.08, 0.92, int(rng.integers(3, 6))) * length_mm
    kink = size * rng.normal(0.0, 2.6, at.size) / length_mm
    top, reach = size * rng.normal(0.0, 0.55, at.size), rng.uniform(10.0, 60.0, at.size)

    def value(x: F) -> F:
        d = np.abs(x[..., None] - at)
        out: F = base(x) + (kink * d + top * np.exp(-d / reach)).sum(axis=-1)
        return out

    return value


def bumpy(rng: Rng, length_mm: float, size: float) -> Curve:
    """A Fourier series of 15 half waves and local bumps of 1 to 3 % of the stroke."""
    k = np.arange(1, 16)
    a, phase = size * rng.standard_normal(k.size) * 1.4 / k**1.5, rng.uniform(0.0, 2.0 * np.pi, k.size)
    n = int(rng.integers(2, 5))
    at, width, top = rng.uniform(0.0, length_mm, n), rng.uniform(0.01, 0.03, n) * length_mm, size * rng.normal(0.0, 0.7, n)

    def value(x: F) -> F:
        x = x[..., None]
        out: F = (a * np.cos(np.pi * k * x / length_mm + phase)).sum(axis=-1)
        return out + (top * np.exp(-0.5 * ((x - at) / width) ** 2)).sum(axis=-1)

    return value


def walking(rng: Rng, length_mm: float, size: float) -> Curve:
    """A random walk over nodes of 10 mm, straight between them."""
    x = np.arange(0.0, length_mm + 10.0, 10.0)
    y = np.cumsum(size * rng.standard_normal(x.size))
    return lambda at: np.interp(at, x, y)


def draw(rng: Rng, stroke_mm: F, sizes: Sizes, shape: Shape, factor: float = 1.0) -> tuple[tuple[Curve, ...], ...]:
    """The 18 curves of a machine, all sizes times ``factor``."""
    return tuple(tuple(_motion(rng, float(np.ptp(stroke_mm[j])), j, c, sizes, shape, factor) for c in range(6)) for j in range(3))


def _motion(rng: Rng, length_mm: float, axis: int, component: int, sizes: Sizes, shape: Shape, factor: float) -> Curve:
    kind = ANGLE if component >= 3 else POSITIONING if component == axis else STRAIGHTNESS
    own = shape(rng, length_mm, factor * sizes.shape[kind] * float(np.exp(rng.normal(0.0, 0.35))))
    per_mm = factor * rng.standard_normal() * (1e-3 * sizes.scale, 0.0, sizes.angle_slope / length_mm)[kind]
    if kind == STRAIGHTNESS:
        x = np.linspace(0.0, length_mm, 401)
        slope, start = np.polyfit(x, own(x), 1)
        return lambda at: own(at) - start - slope * at
    start = float(own(np.zeros(1))[0])
    return lambda at: own(at) - start + per_mm * at


def screw(rng: Rng, curve: Curve, waves_um: tuple[tuple[float, float], ...]) -> Curve:
    """A positioning with waves of a screw added: amplitudes µm and periods mm."""
    phases = rng.uniform(0.0, 2.0 * np.pi, len(waves_um))

    def value(x: F) -> F:
        out = curve(x)
        for (size, period), phase in zip(waves_um, phases, strict=True):
            out = out + size * (np.sin(2.0 * np.pi * x / period + phase) - np.sin(phase))
        return out

    return value
