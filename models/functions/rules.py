"""The field's rules for error functions, kept by construction: straightness has no line, angles and positioning start from zero.

What a rule takes away is always handed back: the slope of a straightness is squareness, the value of an angle at its reference turns the
frame. math.md 1: "Straightness functions have zero LS slope by definition. Angular functions have zero value at the reference point."
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from abbe.models.functions.axis_function import AxisFunction, interval
from abbe.models.functions.line_fit import straight_line
from abbe.models.functions.quadrature import nodes
from abbe.models.functions.table import Table

PASSES = 2
"""The first takes the line away, the second what rounding left of it."""


@dataclass(frozen=True, slots=True)
class Straightness:
    """A function without line, and the line: ``original(x) = function(x) + offset_mm + slope * x_mm``.

    Parameters
    ----------
    function : AxisFunction
        Zero least-squares offset and slope over the stroke.
    offset_mm : float
        Value of the removed line at axis coordinate zero.
    slope : float
        Slope of the removed line, mm/mm = rad: it belongs to squareness (`abbe.models.functions.motions.ErrorMotions.straightened`).
    """

    function: AxisFunction
    offset_mm: float
    slope: float


@dataclass(frozen=True, slots=True)
class FromZero:
    """A function that is zero at its reference, and the constant: ``original(x) = function(x) + constant``."""

    function: AxisFunction
    constant: float


def as_straightness(function: AxisFunction, stroke_mm: ArrayLike) -> Straightness:
    """Take the least-squares line over the stroke away.

    For polynomials, Legendre series and B-splines the line minimises the INTEGRAL of the squared rest over the stroke, integrated exactly
    (Gauss-Legendre on every polynomial piece). For a table it minimises the SUM of squares over the table's own positions inside the
    stroke, which is what instruments do with their readings.

    Parameters
    ----------
    function : AxisFunction
        Straightness in mm, line included.
    stroke_mm : (smaller, larger)

    Returns
    -------
    Straightness

    Raises
    ------
    ValueError
        The stroke is empty, goes beyond the function's domain, or holds fewer than two positions of a table.
    """
    stroke = _inside(function, stroke_mm)
    offset = slope = 0.0
    for _ in range(PASSES):
        step, value = _line(function, stroke)
        function = function.plus_line(-value, -step)
        offset, slope = offset + value, slope + step
    return Straightness(function, offset, slope)


def as_angle(function: AxisFunction, reference_mm: float) -> FromZero:
    """Make an angular error zero at the axis' reference; the constant is the carriage's resting angle, rad.

    Raises
    ------
    ValueError
        The reference lies outside the function's domain.
    """
    lo, hi = function.domain_mm
    if not lo <= reference_mm <= hi:
        raise ValueError(f"reference_mm = {reference_mm:g} lies outside the function's domain, {lo:g} to {hi:g} mm")
    constant = 0.0
    for _ in range(PASSES):
        value = float(function(reference_mm))
        function, constant = function.plus_line(-value, 0.0), constant + value
    return FromZero(function, constant)


def as_positioning(function: AxisFunction, start_mm: float) -> FromZero:
    """Make a positioning error zero where the measurement starts; the constant is a zero shift, mm. Errors as in `as_angle`."""
    return as_angle(function, start_mm)


def least_squares_line(function: AxisFunction, stroke_mm: ArrayLike) -> tuple[float, float]:
    """Slope (per mm) and value at axis coordinate zero of the line that `as_straightness` removes; errors as there."""
    return _line(function, _inside(function, stroke_mm))


def _line(function: AxisFunction, stroke: tuple[float, float]) -> tuple[float, float]:
    middle, half = 0.5 * (stroke[0] + stroke[1]), 0.5 * (stroke[1] - stroke[0])
    if isinstance(function, Table):
        inside = (function.position_mm >= stroke[0]) & (function.position_mm <= stroke[1])
        if inside.sum() < 2:
            raise ValueError(f"straightness: the table has fewer than two positions between {stroke[0]:g} and {stroke[1]:g} mm")
        slope, value = straight_line(function.position_mm[inside] - middle, function.value[inside])
    else:
        x, weight = nodes(stroke, function.breaks_mm, (function.degree + 3) // 2)
        y = function(x)
        share = weight / (2.0 * half)
        value, slope = float(share @ y), 3.0 / half * float(share @ (y * (x - middle) / half))
    return slope, value - slope * middle


def _inside(function: AxisFunction, stroke_mm: ArrayLike) -> tuple[float, float]:
    stroke, (lo, hi) = interval("stroke_mm", stroke_mm), function.domain_mm
    slack = 1e-9 * (stroke[1] - stroke[0])
    if stroke[0] < lo - slack or stroke[1] > hi + slack:
        raise ValueError(f"stroke {stroke[0]:g} to {stroke[1]:g} mm goes beyond the function's domain, {lo:g} to {hi:g} mm")
    return float(np.clip(stroke[0], lo, hi)), float(np.clip(stroke[1], lo, hi))
