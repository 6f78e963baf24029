"""Tabulated error function: values at positions, as instruments deliver and controllers accept them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal, Self

import numpy as np
import scipy
from numpy.typing import ArrayLike

from abbe.models.arrays import F1, F2
from abbe.models.functions.axis_function import frozen_vector, positions, same_size

Interpolation = Literal["linear", "cubic"]


@dataclass(frozen=True, eq=False)
class Table:
    """Values at positions, with linear or cubic-spline interpolation between them.

    Outside the positions the end value holds and the slope is zero, as in controllers. ``cubic`` is the not-a-knot cubic spline; with three
    positions it is a parabola, with two a line.

    Parameters
    ----------
    position_mm : array, shape (m,), m >= 2
        Rising.
    value : array, shape (m,)
        mm or rad.
    interpolation : "linear" or "cubic"

    Raises
    ------
    ValueError
        Positions do not rise, lengths differ, a number is not finite, or the cubic spline overflows float64.
    """

    position_mm: F1
    value: F1
    interpolation: Interpolation = "linear"
    _spline: Any = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Check the numbers and build the spline."""
        object.__setattr__(self, "position_mm", frozen_vector("position_mm", self.position_mm, 2))
        object.__setattr__(self, "value", frozen_vector("value", self.value, 2))
        if self.position_mm.size != self.value.size:
            raise ValueError(f"table: expected one value per position, got {self.value.size} values and {self.position_mm.size} positions")
        if (np.diff(self.position_mm) <= 0.0).any():
            row = int(np.argmax(np.diff(self.position_mm) <= 0.0)) + 2
            raise ValueError(f"table: position_mm[{row}] = {self.position_mm[row - 1]:g}: expected positions that rise")
        if self.interpolation not in ("linear", "cubic"):
            raise ValueError(f"table: interpolation {self.interpolation!r}, expected 'linear' or 'cubic'")
        object.__setattr__(self, "_spline", _cubic(self.position_mm, self.value) if self.interpolation == "cubic" else None)

    @property
    def domain_mm(self) -> tuple[float, float]:
        """First and last position."""
        return float(self.position_mm[0]), float(self.position_mm[-1])

    @property
    def parameters(self) -> F1:
        """Linear parameters: the values of the table."""
        return self.value

    @property
    def breaks_mm(self) -> F1:
        """Positions at which the curve may bend: those of the table."""
        return self.position_mm

    @property
    def degree(self) -> int:
        """Degree of the polynomials between the positions: 1 or 3."""
        return 1 if self.interpolation == "linear" else 3

    def __call__(self, x_mm: ArrayLike) -> F1:
        """Return values at positions of any shape."""
        x = positions(x_mm)
        if self._spline is None:
            return np.asarray(np.interp(x, self.position_mm, self.value), dtype=np.float64)
        return np.asarray(self._spline(np.clip(x, *self.domain_mm)), dtype=np.float64)

    def derivative(self, x_mm: ArrayLike) -> F1:
        """Return the slope per mm at positions of any shape.

        At a position of a linear table this is the slope of the interval to the RIGHT; at the last position, of the interval to the left.
        """
        x, (lo, hi) = positions(x_mm), self.domain_mm
        if self._spline is None:
            at = np.clip(np.searchsorted(self.position_mm, x, side="right") - 1, 0, self.value.size - 2)
            slope = (np.diff(self.value) / np.diff(self.position_mm))[at]
        else:
            slope = self._spline(np.clip(x, lo, hi), 1)
        return np.where((x >= lo) & (x <= hi), slope, 0.0)

    def basis(self, x_mm: F1) -> F2:
        """Return the derivative with respect to each value, shape (n, m): hat functions, or cubic splines through a single 1."""
        x, unit = np.clip(positions(x_mm), *self.domain_mm), np.eye(self.value.size)
        if self._spline is None:
            return np.stack([np.interp(x, self.position_mm, one) for one in unit], axis=-1)
        return np.asarray(scipy.interpolate.CubicSpline(self.position_mm, unit)(x), dtype=np.float64)

    def with_parameters(self, parameters: ArrayLike) -> Self:
        """Return a table with other values at the same positions."""
        return replace(self, value=same_size(parameters, self.value))

    def plus_line(self, offset: float, slope: float) -> Table:
        """Return this table + offset + slope * x_mm."""
        return replace(self, value=self.value + offset + slope * self.position_mm)


def _cubic(position_mm: F1, value: F1) -> Any:
    try:
        with np.errstate(all="ignore"):
            spline = scipy.interpolate.CubicSpline(position_mm, value)
    except ValueError:
        spline = None  # scipy's solver met an infinity
    if spline is None or not np.isfinite(spline.c).all():
        raise ValueError("table: the values are too large or too steep for a cubic spline; use linear interpolation")
    return spline
