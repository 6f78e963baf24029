"""From one kind of error function to another, with the error of doing so; and from samples to a kind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np
from numpy.polynomial import Legendre as NumpyLegendre
from numpy.polynomial import Polynomial as NumpyPolynomial
from numpy.typing import ArrayLike

from abbe.models.arrays import F1
from abbe.models.functions.axis_function import AxisFunction, interval, positions
from abbe.models.functions.bspline import BSpline, clamped_knots
from abbe.models.functions.legendre import Legendre
from abbe.models.functions.motions import nodes
from abbe.models.functions.polynomial import Polynomial
from abbe.models.functions.table import Table

Kind = Literal["polynomial", "legendre", "bspline", "table"]
GRID = 2001
K = TypeVar("K", bound=AxisFunction)


@dataclass(frozen=True, slots=True)
class Converted:
    """A function of the wanted kind and how far it is from what it was made of.

    Parameters
    ----------
    function : AxisFunction
    max_error, rms_error : float
        Largest and root mean square difference, unit of the function (mm or rad).
    at_mm : float
        Where the largest stands.
    """

    function: AxisFunction
    max_error: float
    rms_error: float
    at_mm: float


def form(kind: Kind, stroke_mm: ArrayLike, order: int | None = None, pieces: int | None = None) -> AxisFunction:
    """An error function of a kind that is zero everywhere: the form that `convert` and `fit` fill.

    Parameters
    ----------
    kind : "polynomial", "legendre", "bspline" or "table"
    stroke_mm : (smaller, larger)
        Powers of a polynomial count from the smaller.
    order : int, optional
        Highest power of polynomial and Legendre series (needed there), degree of the spline (default 3), 1 or 3 for a linear or cubic
        table (default 1).
    pieces : int, optional
        Intervals of equal length of spline and table (needed there).

    Raises
    ------
    ValueError
        Another kind, or a number is missing or impossible.
    """
    stroke = interval("stroke_mm", stroke_mm)
    if kind in ("polynomial", "legendre"):
        if order is None or order < 0:
            raise ValueError(f"{kind}: order must be 0 or more, got {order}")
        zeros = np.zeros(order + 1)
        return Polynomial(zeros, stroke[0]) if kind == "polynomial" else Legendre(zeros, stroke)
    if kind not in ("bspline", "table"):
        raise ValueError(f"kind {kind!r}, expected 'polynomial', 'legendre', 'bspline' or 'table'")
    if pieces is None or pieces < 1:
        raise ValueError(f"{kind}: pieces must be 1 or more, got {pieces}")
    if kind == "bspline":
        degree = 3 if order is None else order
        return BSpline(clamped_knots(stroke, pieces, degree), np.zeros(pieces + degree), degree)
    if order not in (None, 1, 3):
        raise ValueError(f"table: order 1 is linear, 3 is cubic, got {order}")
    return Table(np.linspace(*stroke, pieces + 1), np.zeros(pieces + 1), "cubic" if order == 3 else "linear")


def convert(
    function: AxisFunction,
    kind: Kind | AxisFunction,
    *,
    stroke_mm: ArrayLike | None = None,
    order: int | None = None,
    pieces: int | None = None,
) -> Converted:
    """Write an error function as another kind and say what is lost.

    A table takes the values at its positions; the other kinds minimise the integral of the squared difference over the stroke, integrated
    exactly. What the new kind can hold is exact to rounding: polynomial and Legendre series of the same order, a polynomial of degree 3
    as cubic spline, a linear table as spline of degree 1 on the same knots.

    Parameters
    ----------
    function : AxisFunction
    kind : str or AxisFunction
        Name of a kind, or a function whose form (origin, knots, positions) is wanted; its parameters do not matter.
    stroke_mm : (smaller, larger), optional
        Where the two must agree; the function's domain when left out (a polynomial has none).
    order, pieces : int, optional
        As in `form`; the order of a polynomial or Legendre series is kept when left out between these two.

    Returns
    -------
    Converted
        Differences on 2001 equal steps, on every node of both functions and midway between nodes; the rms is over the equal steps.

    Raises
    ------
    ValueError
        No finite stroke, or a form that cannot be filled.
    """
    stroke = interval("stroke_mm", function.domain_mm if stroke_mm is None else stroke_mm)
    if isinstance(kind, str):
        if order is None and kind in ("polynomial", "legendre") and isinstance(function, (Polynomial, Legendre)):
            order = function.degree
        kind = form(kind, stroke, order, pieces)
    result = _filled(function, kind, stroke)
    return _compared(function, result, stroke)


def fit(x_mm: ArrayLike, y: ArrayLike, kind: Kind | AxisFunction, *, order: int | None = None, pieces: int | None = None) -> Converted:
    """Least-squares fit of samples.

    Parameters
    ----------
    x_mm, y : arrays, shape (n,)
        Positions in any order, and values (mm or rad).
    kind, order, pieces
        As in `convert`; a named kind spans the positions.

    Returns
    -------
    Converted
        Residuals at the samples.

    Raises
    ------
    ValueError
        Shapes differ, a number is not finite, or the samples do not determine every parameter.
    """
    x, values = positions(x_mm), np.asarray(y, dtype=np.float64)
    if x.ndim != 1 or x.size == 0 or x.shape != values.shape or not np.isfinite(values).all():
        raise ValueError(f"samples: expected n finite positions and n finite values, got shapes {x.shape} and {values.shape}")
    shape = form(kind, (float(x.min()), float(x.max())), order, pieces) if isinstance(kind, str) else kind
    if isinstance(shape, Polynomial):
        # By way of the Legendre series: powers of a long stroke are nearly dependent.
        span = (float(x.min()), float(x.max()))
        result: AxisFunction = _powers(_solved(Legendre(np.zeros(shape.degree + 1), span), x, values), shape)
    else:
        result = _solved(shape, x, values)
    off = result(x) - values
    return Converted(result, float(np.abs(off).max()), float(np.sqrt(np.mean(off**2))), float(x[np.abs(off).argmax()]))


def _filled(function: AxisFunction, shape: AxisFunction, stroke: tuple[float, float]) -> AxisFunction:
    if isinstance(shape, Table):
        return shape.with_parameters(function(shape.position_mm))
    if isinstance(shape, Polynomial):
        return _powers(_projected(function, Legendre(np.zeros(shape.degree + 1), stroke), stroke), shape)
    return _projected(function, shape, stroke)


def _projected(function: AxisFunction, shape: K, stroke: tuple[float, float]) -> K:
    x, w = nodes(stroke, np.concatenate([function.breaks_mm, shape.breaks_mm]), max(function.degree, shape.degree) + 1)
    return _solved(shape, x, function(x), np.sqrt(w / w.sum()))


def _solved(shape: K, x: F1, y: F1, weight: F1 | None = None) -> K:
    w = np.ones(x.size) if weight is None else weight
    matrix = shape.basis(x) * w[:, None]
    solution, _, rank, _ = np.linalg.lstsq(matrix, y * w, rcond=None)
    if rank < shape.parameters.size:
        raise ValueError(f"{shape.parameters.size} parameters are wanted, but these samples or this stroke determine {int(rank)}")
    return shape.with_parameters(solution)


def _powers(series: Legendre, shape: Polynomial) -> Polynomial:
    """The same polynomial in powers of (x - origin): algebra, no fit."""
    window = [shape.origin_mm - 1.0, shape.origin_mm + 1.0]
    powers = (
        NumpyLegendre(series.coefficients, domain=series.stroke_mm).convert(domain=window, kind=NumpyPolynomial, window=[-1.0, 1.0]).coef
    )
    coefficients = np.zeros(shape.coefficients.size)
    coefficients[: powers.size] = powers
    return shape.with_parameters(coefficients)


def _compared(a: AxisFunction, b: AxisFunction, stroke: tuple[float, float]) -> Converted:
    even = np.linspace(*stroke, GRID)
    knots = np.concatenate([a.breaks_mm, b.breaks_mm])
    knots = np.unique(knots[(knots >= stroke[0]) & (knots <= stroke[1])])
    x = np.concatenate([even, knots, 0.5 * (knots[1:] + knots[:-1])])
    off = np.abs(a(x) - b(x))
    return Converted(b, float(off.max()), float(np.sqrt(np.mean(off[:GRID] ** 2))), float(x[off.argmax()]))
