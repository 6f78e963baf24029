"""Polynomial error function: kind ``polynomial`` of the exchange format."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import ArrayLike

from abbe.models.arrays import F1, F2
from abbe.models.functions.axis_function import frozen_vector, positions, same_size


@dataclass(frozen=True, eq=False)
class Polynomial:
    """value(x) = sum of c_k (x - origin)^k.

    It has no domain limits and grows outside the stroke; a caller that must not extrapolate has to check the positions.

    Parameters
    ----------
    coefficients : array, shape (m,), m >= 1
        c_0, c_1, ...: mm or rad per mm^k.
    origin_mm : float
        Position from which powers are counted.

    Raises
    ------
    ValueError
        No coefficient, or a number that is not finite.
    """

    coefficients: F1
    origin_mm: float = 0.0
    _slopes: F1 = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Check the numbers and compute the derivative's coefficients."""
        object.__setattr__(self, "coefficients", frozen_vector("coefficients", self.coefficients))
        object.__setattr__(self, "origin_mm", float(positions(self.origin_mm)))
        object.__setattr__(self, "_slopes", polynomial.polyder(self.coefficients))

    @property
    def domain_mm(self) -> tuple[float, float]:
        """All positions: the polynomial has no limits."""
        return -np.inf, np.inf

    @property
    def parameters(self) -> F1:
        """Linear parameters: the coefficients."""
        return self.coefficients

    @property
    def breaks_mm(self) -> F1:
        """Empty: one polynomial everywhere."""
        return np.empty(0)

    @property
    def degree(self) -> int:
        """Number of coefficients less one."""
        return self.coefficients.size - 1

    def __call__(self, x_mm: ArrayLike) -> F1:
        """Return values at positions of any shape."""
        return np.asarray(polynomial.polyval(positions(x_mm) - self.origin_mm, self.coefficients), dtype=np.float64)

    def derivative(self, x_mm: ArrayLike) -> F1:
        """Return slopes per mm at positions of any shape."""
        return np.asarray(polynomial.polyval(positions(x_mm) - self.origin_mm, self._slopes), dtype=np.float64)

    def basis(self, x_mm: F1) -> F2:
        """Return the powers (x - origin)^k, shape (n, m)."""
        return np.asarray(polynomial.polyvander(positions(x_mm) - self.origin_mm, self.degree), dtype=np.float64)

    def with_parameters(self, parameters: ArrayLike) -> Self:
        """Return a polynomial about the same origin with other coefficients."""
        return replace(self, coefficients=same_size(parameters, self.coefficients))

    def plus_line(self, offset: float, slope: float) -> Polynomial:
        """Return this polynomial + offset + slope * x_mm; a constant gets a second coefficient if needed."""
        size = max(self.coefficients.size, 2 if slope != 0.0 else 1)
        coefficients = np.zeros(size)
        coefficients[: self.coefficients.size] = self.coefficients
        coefficients[0] += offset + slope * self.origin_mm
        if slope != 0.0:
            coefficients[1] += slope
        return Polynomial(coefficients, self.origin_mm)
