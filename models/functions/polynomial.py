"""Polynomial error function: kind ``polynomial`` of the exchange format; and least-squares straight lines through measured errors."""

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


def straight_line(x: F1, y: F1) -> tuple[float, float]:
    """Fit an ordinary least-squares line.

    Parameters
    ----------
    x, y : arrays, shape (n,)
        Positions and values, any units.

    Returns
    -------
    tuple of float
        Slope (unit of y per unit of x) and value at x = 0.

    Raises
    ------
    ValueError
        Shapes differ, or fewer than two different positions.
    """
    a, b = _pair(x, y)
    centred = a - a.mean()
    power = float(centred @ centred)
    if power == 0.0:
        raise ValueError("straight line: at least two different positions are needed")
    slope = float(centred @ b) / power
    return slope, float(b.mean() - slope * a.mean())


def slope_through_origin(x: F1, y: F1) -> float:
    """Return the least-squares slope of a line through (0, 0), as in the laser columns of Yang and Kim's Table 2.

    Shapes, units and errors are those of `straight_line`, but one position other than zero is enough.
    """
    a, b = _pair(x, y)
    power = float(a @ a)
    if power == 0.0:
        raise ValueError("slope through the origin: at least one position other than zero is needed")
    return float(a @ b) / power


def _pair(x: F1, y: F1) -> tuple[F1, F1]:
    a, b = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if a.ndim != 1 or a.shape != b.shape or a.size == 0:
        raise ValueError(f"straight line: positions and values must be vectors of one length, got shapes {a.shape} and {b.shape}")
    return a, b
