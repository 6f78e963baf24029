"""B-spline error function: smooth, with as much detail as its knots allow."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
import scipy
from numpy.typing import ArrayLike

from abbe.models.arrays import F1, F2
from abbe.models.functions.axis_function import frozen_vector, interval, positions, same_size


@dataclass(frozen=True, eq=False)
class BSpline:
    """value(x) = sum of c_i B_i(x) on knots t, between t[degree] and t[m] (m coefficients).

    Outside this interval the end value holds and the slope is zero, as in controllers; at the two ends the slope is the inner one. Where
    ``degree`` knots coincide the slope may jump; ``derivative`` then returns the slope on the right.

    Parameters
    ----------
    knots_mm : array, shape (m + degree + 1,)
        Not decreasing. An inner knot occurs at most ``degree`` times, so that the function is continuous; the first and the last may
        occur ``degree`` + 1 times (clamped spline).
    coefficients : array, shape (m,), m > degree
        mm or rad.
    degree : int, 1 to 9

    Raises
    ------
    ValueError
        Knots, coefficients and degree do not fit together, or a number is not finite.
    """

    knots_mm: F1
    coefficients: F1
    degree: int = 3
    _spline: Any = field(init=False, repr=False)
    _slopes: Any = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Check the knots and build the spline and its derivative."""
        object.__setattr__(self, "knots_mm", frozen_vector("knots_mm", self.knots_mm))
        object.__setattr__(self, "coefficients", frozen_vector("coefficients", self.coefficients))
        t, m, k = self.knots_mm, self.coefficients.size, self.degree
        if not 1 <= k <= 9 or m <= k or t.size != m + k + 1:
            raise ValueError(f"bspline: {m} coefficients of degree {k} (1 to 9) need {m + k + 1} knots, got {t.size}")
        if (np.diff(t) < 0.0).any():
            raise ValueError("bspline: knots_mm must never decrease")
        often = t[1:m] == t[k + 1 : m + k]
        if often.any():
            knot = float(t[1 + int(np.argmax(often))])
            limit = k + 1 if knot in (t[0], t[-1]) else k
            raise ValueError(f"bspline: knot {knot:g} occurs more than {limit} times (inner knots at most {k}, first and last {k + 1})")
        if not t[k] < t[m]:
            raise ValueError(f"bspline: knots_mm must rise from knot {k + 1} to knot {m + 1}, the ends of the function's domain")
        object.__setattr__(self, "_spline", scipy.interpolate.BSpline(t, self.coefficients, k))
        with np.errstate(over="ignore"):
            object.__setattr__(self, "_slopes", self._spline.derivative())

    @property
    def domain_mm(self) -> tuple[float, float]:
        """From knot ``degree`` to knot ``m``."""
        return float(self.knots_mm[self.degree]), float(self.knots_mm[self.coefficients.size])

    @property
    def parameters(self) -> F1:
        """Linear parameters: the coefficients."""
        return self.coefficients

    @property
    def breaks_mm(self) -> F1:
        """The different knots of the domain."""
        return np.unique(self.knots_mm[self.degree : self.coefficients.size + 1])

    def __call__(self, x_mm: ArrayLike) -> F1:
        """Return values at positions of any shape."""
        return np.asarray(self._spline(np.clip(positions(x_mm), *self.domain_mm)), dtype=np.float64)

    def derivative(self, x_mm: ArrayLike) -> F1:
        """Return slopes per mm at positions of any shape."""
        x, (lo, hi) = positions(x_mm), self.domain_mm
        return np.where((x >= lo) & (x <= hi), self._slopes(np.clip(x, lo, hi)), 0.0)

    def basis(self, x_mm: F1) -> F2:
        """Return B_i at the positions, shape (n, m)."""
        x = np.clip(positions(x_mm), *self.domain_mm)
        if x.size == 0:
            return np.zeros((0, self.coefficients.size))  # scipy looks for the least position
        matrix = scipy.interpolate.BSpline.design_matrix(x, self.knots_mm, self.degree)
        return np.asarray(matrix.toarray(), dtype=np.float64)

    def with_parameters(self, parameters: ArrayLike) -> Self:
        """Return a spline with the same knots and other coefficients."""
        return replace(self, coefficients=same_size(parameters, self.coefficients))

    def plus_line(self, offset: float, slope: float) -> BSpline:
        """Return this spline + offset + slope * x_mm, exactly: the coefficients of x_mm are the means of ``degree`` neighbouring knots."""
        k, m = self.degree, self.coefficients.size
        greville = np.array([self.knots_mm[i + 1 : i + k + 1].mean() for i in range(m)])
        return replace(self, coefficients=self.coefficients + offset + slope * greville)


def clamped_knots(stroke_mm: ArrayLike, pieces: int, degree: int = 3) -> F1:
    """Return the knots, mm, of a clamped spline with ``pieces`` equal intervals over a stroke: it has ``pieces + degree`` coefficients.

    Raises
    ------
    ValueError
        No piece, degree below 1, or an empty stroke.
    """
    lo, hi = interval("stroke_mm", stroke_mm)
    if pieces < 1 or degree < 1:
        raise ValueError(f"bspline: {pieces} pieces of degree {degree}, expected 1 or more of each")
    return np.concatenate([np.full(degree, lo), np.linspace(lo, hi, pieces + 1), np.full(degree, hi)])
