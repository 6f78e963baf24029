"""Interface of all error functions of one axis."""

from __future__ import annotations

from typing import Protocol, Self

import numpy as np
from numpy.typing import ArrayLike

from abbe.models.arrays import F1, F2


class AxisFunction(Protocol):
    """An error motion as a function of the position of ONE axis: mm for translations, rad for angles.

    Every kind is linear in its parameters: ``f(x) == basis(x) @ parameters``. That is what fits and uncertainty rest on.
    """

    @property
    def domain_mm(self) -> tuple[float, float]:
        """Interval in which the function is defined; each kind states what holds outside."""

    @property
    def parameters(self) -> F1:
        """Linear parameters, shape (m,): coefficients, or the values of a table."""

    @property
    def breaks_mm(self) -> F1:
        """Positions between which the function is one polynomial, shape (k,), k >= 0."""

    @property
    def degree(self) -> int:
        """Degree of these polynomials."""

    def __call__(self, x_mm: ArrayLike) -> F1:
        """Values at positions of any shape, same shape. ValueError: a position is not finite."""

    def derivative(self, x_mm: ArrayLike) -> F1:
        """Slope per mm at positions of any shape, same shape. ValueError: a position is not finite."""

    def basis(self, x_mm: F1) -> F2:
        """Derivative of the value with respect to each parameter: shape (n,) gives (n, m)."""

    def with_parameters(self, parameters: ArrayLike) -> Self:
        """The same kind on the same domain with other parameters, shape (m,)."""

    def plus_line(self, offset: float, slope: float) -> AxisFunction:
        """This function plus ``offset + slope * x_mm`` on its domain, of the same kind: every kind can hold a straight line exactly."""


def positions(x_mm: ArrayLike) -> F1:
    """Positions as float64 of any shape.

    Raises
    ------
    ValueError
        One is NaN or infinite.
    """
    x = np.asarray(x_mm, dtype=np.float64)
    if not np.isfinite(x).all():
        raise ValueError("axis position: expected finite numbers, got NaN or infinity")
    return x


def frozen_vector(name: str, values: ArrayLike, least: int = 1) -> F1:
    """A read-only copy of a vector with at least ``least`` finite numbers; ValueError otherwise."""
    copy = np.array(values, dtype=np.float64)
    if copy.ndim != 1 or copy.size < least or not np.isfinite(copy).all():
        raise ValueError(f"{name}: expected {least} or more finite numbers in one row, got shape {copy.shape}")
    copy.setflags(write=False)
    return copy


def interval(name: str, pair_mm: ArrayLike) -> tuple[float, float]:
    """A stroke as (smaller, larger); ValueError unless two finite numbers in this order."""
    pair = np.asarray(pair_mm, dtype=np.float64)
    if pair.shape != (2,) or not np.isfinite(pair).all() or not pair[0] < pair[1]:
        raise ValueError(f"{name}: expected [smaller, larger] in mm, got {pair.tolist()}")
    return float(pair[0]), float(pair[1])


def axes_positions(axes_mm: ArrayLike) -> F2:
    """Commanded positions as float64 of shape (n, 3); ValueError otherwise, or when one is not finite."""
    axes = positions(axes_mm)
    if axes.ndim != 2 or axes.shape[1] != 3:
        raise ValueError(f"axes_mm: expected shape (n, 3), got {axes.shape}")
    return axes


def same_size(parameters: ArrayLike, old: F1) -> F1:
    """Parameters as a vector of the size of the old ones; ValueError otherwise."""
    new = frozen_vector("parameters", parameters)
    if new.size != old.size:
        raise ValueError(f"parameters: expected {old.size} numbers, got {new.size}")
    return new
