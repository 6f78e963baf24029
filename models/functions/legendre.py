"""Legendre series over a stroke: the smooth error function with orthogonal terms."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike

from abbe.models.arrays import F1, F2
from abbe.models.functions.axis_function import frozen_vector, interval, positions, same_size


def legendre_values(x_mm: F1, stroke_mm: ArrayLike, order: int) -> F2:
    """Return Legendre polynomials P0..P_order over the stroke, shape (n, order + 1); outside the stroke the end value holds."""
    return np.asarray(legendre.legvander(_unit(np.asarray(x_mm, dtype=np.float64), stroke_mm), order), dtype=np.float64)


def _unit(x_mm: F1, stroke_mm: ArrayLike) -> F1:
    lo, hi = np.asarray(stroke_mm, dtype=np.float64)
    return np.minimum(np.maximum(2.0 * (x_mm - float(lo)) / (float(hi) - float(lo)) - 1.0, -1.0), 1.0)


@dataclass(frozen=True, eq=False)
class Legendre:
    """value(x) = sum of c_k P_k(u), u = -1 at the start and +1 at the end of the stroke.

    Outside the stroke the end value holds and the slope is zero, as in controllers; at the two ends the slope is the inner one.

    Parameters
    ----------
    coefficients : array, shape (m,), m >= 1
        c_0, c_1, ...: mm or rad. c_0 is the mean over the stroke; c_0 = c_1 = 0 is a straightness free of offset and slope.
    stroke_mm : (smaller, larger)

    Raises
    ------
    ValueError
        No coefficient, an empty stroke, or a number that is not finite.
    """

    coefficients: F1
    stroke_mm: tuple[float, float]
    _slopes: F1 = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Check the numbers and compute the derivative's coefficients, per mm."""
        object.__setattr__(self, "coefficients", frozen_vector("coefficients", self.coefficients))
        object.__setattr__(self, "stroke_mm", interval("stroke_mm", self.stroke_mm))
        per_mm = 2.0 / (self.stroke_mm[1] - self.stroke_mm[0])
        object.__setattr__(self, "_slopes", legendre.legder(self.coefficients) * per_mm)

    @property
    def domain_mm(self) -> tuple[float, float]:
        """The stroke."""
        return self.stroke_mm

    @property
    def parameters(self) -> F1:
        """Linear parameters: the coefficients."""
        return self.coefficients

    @property
    def breaks_mm(self) -> F1:
        """The ends of the stroke."""
        return np.array(self.stroke_mm)

    @property
    def degree(self) -> int:
        """Number of coefficients less one."""
        return self.coefficients.size - 1

    def __call__(self, x_mm: ArrayLike) -> F1:
        """Return values at positions of any shape."""
        return np.asarray(legendre.legval(_unit(positions(x_mm), self.stroke_mm), self.coefficients), dtype=np.float64)

    def derivative(self, x_mm: ArrayLike) -> F1:
        """Return slopes per mm at positions of any shape."""
        x = positions(x_mm)
        inside = (x >= self.stroke_mm[0]) & (x <= self.stroke_mm[1])
        return np.where(inside, legendre.legval(_unit(x, self.stroke_mm), self._slopes), 0.0)

    def basis(self, x_mm: F1) -> F2:
        """Return P_k at the positions, shape (n, m)."""
        return legendre_values(positions(x_mm), self.stroke_mm, self.degree)

    def with_parameters(self, parameters: ArrayLike) -> Self:
        """Return a series over the same stroke with other coefficients."""
        return replace(self, coefficients=same_size(parameters, self.coefficients))

    def plus_line(self, offset: float, slope: float) -> Legendre:
        """Return this series + offset + slope * x_mm; a constant gets a second coefficient if needed."""
        lo, hi = self.stroke_mm
        coefficients = np.zeros(max(self.coefficients.size, 2 if slope != 0.0 else 1))
        coefficients[: self.coefficients.size] = self.coefficients
        coefficients[0] += offset + slope * 0.5 * (lo + hi)
        if slope != 0.0:
            coefficients[1] += slope * 0.5 * (hi - lo)
        return Legendre(coefficients, self.stroke_mm)
