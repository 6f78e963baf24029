"""Interface of all error functions of one axis."""

from __future__ import annotations

from typing import Protocol, Self

import numpy as np
from numpy.typing import ArrayLike

from abbe.models.arrays import F1, F2


class AxisFunction(Protocol):
    """An error motion as a function of the position of ONE axis: mm for translations, rad for angles.

    Every kind of function is linear in its parameters, ``f(x) == basis(x) @ parameters``; fits and uncertainties rely on that.
    """

    @property
    def domain_mm(self) -> tuple[float, float]:
        """Interval in which the function is defined; each kind documents its values outside."""

    @property
    def parameters(self) -> F1:
        """Linear parameters, shape (m,): coefficients, or the values of a table."""

    @property
    def breaks_mm(self) -> F1:
        """Rising positions, shape (k,), k >= 0: between neighbours the function is one polynomial."""

    @property
    def degree(self) -> int:
        """Degree of these polynomials."""

    def __call__(self, x_mm: ArrayLike) -> F1:
        """Return values, mm or rad, in the shape of ``x_mm``; ValueError if a position is not finite."""

    def derivative(self, x_mm: ArrayLike) -> F1:
        """Return slopes per mm in the shape of ``x_mm``; ValueError if a position is not finite."""

    def basis(self, x_mm: F1) -> F2:
        """Return the derivative of the value with respect to each parameter, shape (n, m) for n positions."""

    def with_parameters(self, parameters: ArrayLike) -> Self:
        """Return a function of the same kind and domain with other parameters, shape (m,)."""

    def plus_line(self, offset: float, slope: float) -> AxisFunction:
        """Return this function plus ``offset + slope * x_mm`` on its domain; every kind can represent a straight line exactly."""


def positions(x_mm: ArrayLike) -> F1:
    """Return positions as float64; ValueError if one is NaN or infinite."""
    x = np.asarray(x_mm, dtype=np.float64)
    if not np.isfinite(x).all():
        raise ValueError("axis position: expected finite numbers, got NaN or infinity")
    return x


def frozen_vector(name: str, values: ArrayLike, least: int = 1) -> F1:
    """Return a read-only copy of a vector; ValueError unless it holds at least ``least`` finite numbers."""
    copy = np.array(values, dtype=np.float64)
    if copy.ndim != 1 or copy.size < least or not np.isfinite(copy).all():
        raise ValueError(f"{name}: expected {least} or more finite numbers in one row, got shape {copy.shape}")
    copy.setflags(write=False)
    return copy


def interval(name: str, pair_mm: ArrayLike) -> tuple[float, float]:
    """Return a stroke as (smaller, larger); ValueError unless it is two finite numbers in this order."""
    pair = np.asarray(pair_mm, dtype=np.float64)
    if pair.shape != (2,) or not np.isfinite(pair).all() or not pair[0] < pair[1]:
        raise ValueError(f"{name}: expected [smaller, larger] in mm, got {pair.tolist()}")
    return float(pair[0]), float(pair[1])


def axes_positions(axes_mm: ArrayLike) -> F2:
    """Return commanded positions as float64; ValueError if the shape is not (n, 3) or one is not finite."""
    axes = positions(axes_mm)
    if axes.ndim != 2 or axes.shape[1] != 3:
        raise ValueError(f"axes_mm: expected shape (n, 3), got {axes.shape}")
    return axes


def same_size(parameters: ArrayLike, old: F1) -> F1:
    """Return parameters as a vector; ValueError if it has another size than ``old``."""
    new = frozen_vector("parameters", parameters)
    if new.size != old.size:
        raise ValueError(f"parameters: expected {old.size} numbers, got {new.size}")
    return new
