"""The 21 error motions of a machine: six functions per axis, which may depend on the direction of motion, and three squareness errors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike

from abbe.models.arrays import F1, F2, F3
from abbe.models.functions.axis_function import AxisFunction, axes_positions, interval
from abbe.models.functions.polynomial import straight_line
from abbe.models.functions.table import Table
from abbe.models.machine import AXES

PASSES = 2
"""Number of passes that remove a line or a constant; the second removes what rounding left after the first."""
ROTATIONS = ("A", "B", "C")
REVERSE = "@reverse"
SQUARENESS: Mapping[str, tuple[int, int, float]] = MappingProxyType({"C0Y": (1, 0, -1.0), "B0Z": (2, 0, 1.0), "A0Z": (2, 1, -1.0)})
"""Moving axis, component, sign: Y's direction is (-C0Y, 1, 0), Z's direction is (B0Z, -A0Z, 1) (docs/explanation/conventions.md)."""
_SLOPES = {"EXY": ("C0Y", -1.0), "EXZ": ("B0Z", 1.0), "EYZ": ("A0Z", -1.0), "EYX": ("C0Y", -1.0), "EZX": ("B0Z", 1.0), "EZY": ("A0Z", -1.0)}
"""Squareness to which the slope of each straightness belongs, and the sign of its contribution."""
_TURNS = {"EYX": (2, 1.0), "EZX": (1, -1.0), "EZY": (0, 1.0)}
"""Axis and sign of the frame's rotation when the slope of a straightness of the datum axes moves into squareness."""


def nodes(stroke_mm: tuple[float, float], breaks_mm: F1, count: int) -> tuple[F1, F1]:
    """Return Gauss-Legendre nodes and weights over a stroke, piece by piece.

    Parameters
    ----------
    stroke_mm : (smaller, larger)
    breaks_mm : array
        Ends of the pieces, in any order; those outside the stroke are ignored.
    count : int
        Nodes per piece: integrals of polynomials up to degree 2 count - 1 are exact.

    Returns
    -------
    two arrays, shape (pieces * count,)
        Positions and weights in mm; the weights add up to the length of the stroke.
    """
    lo, hi = stroke_mm
    inner = np.unique(breaks_mm[(breaks_mm > lo) & (breaks_mm < hi)])
    edges = np.concatenate([[lo], inner, [hi]])
    u, w = legendre.leggauss(count)
    half = 0.5 * np.diff(edges)[:, None]
    middle = 0.5 * (edges[1:] + edges[:-1])[:, None]
    return (middle + half * u).ravel(), (half * w).ravel()


@dataclass(frozen=True, slots=True)
class Straightness:
    """A straightness split into a curve and a line: ``original(x) = function(x) + offset_mm + slope * x_mm``.

    Parameters
    ----------
    function : AxisFunction
        Zero least-squares offset and slope over the stroke.
    offset_mm : float
        Value of the removed line at axis coordinate zero.
    slope : float
        Slope of the removed line, rad; it belongs to squareness (`ErrorMotions.straightened`).
    """

    function: AxisFunction
    offset_mm: float
    slope: float


@dataclass(frozen=True, slots=True)
class FromZero:
    """A function that is zero at its reference position, and the constant taken off: ``original(x) = function(x) + constant``."""

    function: AxisFunction
    constant: float


def as_straightness(function: AxisFunction, stroke_mm: ArrayLike) -> Straightness:
    """Remove the least-squares line over the stroke from a straightness.

    For polynomials, Legendre series and B-splines the line minimises the INTEGRAL of the squared residual over the stroke, computed
    exactly. For a table it minimises the SUM over the table's positions inside the stroke, as instruments do with their readings.

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
    """Make an angular error zero at a reference position; the constant is the carriage's angle there, rad.

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


def least_squares_line(function: AxisFunction, stroke_mm: ArrayLike) -> tuple[float, float]:
    """Return slope (per mm) and value at axis zero of the line that `as_straightness` removes, with the same errors."""
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


def motion_names(axis: str) -> tuple[str, ...]:
    """Return the ISO 230-1 names of the six error motions of an axis, for X: EXX EYX EZX EAX EBX ECX."""
    return tuple(f"E{c}{axis}" for c in AXES + ROTATIONS)


PLACES: Mapping[str, tuple[int, int]] = MappingProxyType(
    {name: (a, c) for a, x in enumerate(AXES) for c, name in enumerate(motion_names(x))}
)
"""Axis index and component 0..5 of each of the 18 motions."""


@dataclass(frozen=True, slots=True)
class Straightened:
    """Error motions with straight axes: deviation before = deviation after + offset_mm + rotation_rad x commanded position (rule G).

    Parameters
    ----------
    motions : ErrorMotions
        Straightness without lines; their slopes are in the squareness errors.
    offset_mm, rotation_rad : arrays, shape (3,)
        Rigid motion of the frame that belongs to the removed lines.
    """

    motions: ErrorMotions
    offset_mm: F1
    rotation_rad: F1


@dataclass(frozen=True, eq=False)
class ErrorMotions:
    """Error motions as functions of the axis positions (file format ``abbe-errors/1``, docs/how-to/errors.md).

    Squareness multiplies the travel from AXIS ZERO. In `abbe.models.geometry.bases` the travel begins at the start of the stroke; the
    resulting maps differ by a constant offset.

    Parameters
    ----------
    functions : mapping
        ``"EXX"`` .. ``"ECZ"`` in mm or rad; missing ones are zero. ``"EXX@reverse"`` holds after a move in the negative direction;
        without it ``"EXX"`` holds for both directions.
    squareness_rad : mapping
        ``"C0Y"``, ``"B0Z"``, ``"A0Z"``; missing ones are zero.

    Raises
    ------
    ValueError
        An unknown name, or a squareness that is not finite.
    """

    functions: Mapping[str, AxisFunction] = field(default_factory=dict)
    squareness_rad: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check the names and freeze both mappings."""
        for key in self.functions:
            if key.removesuffix(REVERSE) not in PLACES:
                raise ValueError(f"error motion {key!r}: expected one of {', '.join(PLACES)}, with or without {REVERSE}")
        for key, value in self.squareness_rad.items():
            if key not in SQUARENESS or not np.isfinite(value):
                raise ValueError(f"squareness {key!r} = {value}: expected a finite number for C0Y, B0Z or A0Z")
        object.__setattr__(self, "functions", MappingProxyType(dict(self.functions)))
        object.__setattr__(self, "squareness_rad", MappingProxyType({k: float(v) for k, v in self.squareness_rad.items()}))

    def motions(self, axes_mm: ArrayLike, direction: ArrayLike | None = None) -> F3:
        """Return the error motions at positions, squareness included, as `abbe.models.geometry.chain.deviation_mm` takes them.

        Parameters
        ----------
        axes_mm : array, shape (n, 3)
            Commanded positions.
        direction : array, shape (n, 3), optional
            Sign of the last move of each axis, as `abbe.models.geometry.chain.travel_sign` returns it. The ``@reverse`` functions hold
            where this sign is negative, the plain ones elsewhere; without ``direction``, the plain ones everywhere.

        Returns
        -------
        array, shape (n, 3 axes, 6)
            EX EY EZ (mm) and EA EB EC (rad).

        Raises
        ------
        ValueError
            Shapes are wrong or a number is not finite.
        """
        axes, signs = _checked(axes_mm, direction)
        out: F3 = np.zeros((axes.shape[0], 3, 6))
        for key, function in self.functions.items():
            axis, component = PLACES[key.removesuffix(REVERSE)]
            rows = self._rows(key, signs[:, axis])
            out[rows, axis, component] = function(axes[rows, axis])
        for name, value in self.squareness_rad.items():
            axis, component, sign = SQUARENESS[name]
            out[:, axis, component] += sign * value * axes[:, axis]
        return out

    def parameter_names(self) -> tuple[str, ...]:
        """Return the names of all linear parameters: squareness, then ``EXX.k`` with k = 0, 1, ... the coefficient or table row."""
        named = (f"{key}.{k}" for key, function in self.functions.items() for k in range(function.parameters.size))
        return (*SQUARENESS, *named)

    def sensitivities(
        self, names: Iterable[str], axes_mm: ArrayLike, direction: ArrayLike | None = None
    ) -> tuple[list[tuple[int, int]], F2]:
        """Return the derivative of the error motions with respect to each parameter at given positions.

        Parameters
        ----------
        names : iterable of str
            Some of `parameter_names`.
        axes_mm, direction
            As in `motions`.

        Returns
        -------
        list of (axis, component), and array, shape (n, len(names))
            The error motion in which each parameter acts, and the derivative of this motion with respect to it.

        Raises
        ------
        ValueError
            A name is not a parameter of these motions, or an error as in `motions`.
        """
        axes, signs = _checked(axes_mm, direction)
        wanted, known = tuple(names), set(self.parameter_names())
        places: list[tuple[int, int]] = []
        weights: F2 = np.zeros((axes.shape[0], len(wanted)))
        bases: dict[str, F2] = {}
        for column, name in enumerate(wanted):
            if name not in known:
                raise ValueError(f"{name!r} is not a parameter of these error motions")
            if name in SQUARENESS:
                axis, component, sign = SQUARENESS[name]
                weights[:, column] = sign * axes[:, axis]
            else:
                key, _, index = name.rpartition(".")
                axis, component = PLACES[key.removesuffix(REVERSE)]
                if key not in bases:
                    bases[key] = self.functions[key].basis(axes[:, axis])
                rows = self._rows(key, signs[:, axis])
                weights[rows, column] = bases[key][rows, int(index)]
            places.append((axis, component))
        return places, weights

    def straightened(self, stroke_mm: ArrayLike) -> Straightened:
        """Move the slopes of all straightness errors into squareness, and return the rigid motion by which the deviation changes.

        The slopes are those of the lines that `as_straightness` removes.

        Parameters
        ----------
        stroke_mm : array, shape (3, 2)

        Raises
        ------
        ValueError
            A straightness depends on the direction and so has two slopes, or an error as in `as_straightness`.
        """
        strokes = np.asarray(stroke_mm, dtype=np.float64)
        functions, squareness = dict(self.functions), dict.fromkeys(SQUARENESS, 0.0) | dict(self.squareness_rad)
        offset, rotation = np.zeros(3), np.zeros(3)
        for name, (target, sign) in _SLOPES.items():
            if name + REVERSE in functions:
                raise ValueError(f"{name}{REVERSE}: a straightness that depends on the direction has two slopes and cannot be straightened")
            if name not in functions:
                continue
            axis, component = PLACES[name]
            ruled = as_straightness(functions[name], strokes[axis])
            functions[name] = ruled.function
            offset[component] += ruled.offset_mm
            squareness[target] += sign * ruled.slope
            if name in _TURNS:
                about, turn = _TURNS[name]
                rotation[about] += turn * ruled.slope
        return Straightened(ErrorMotions(functions, squareness), offset, rotation)

    def _rows(self, key: str, sign: F1) -> slice | np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Return a mask or slice of the positions at which the function ``key`` holds."""
        if key.endswith(REVERSE):
            return np.asarray(sign < 0.0)
        return np.asarray(sign >= 0.0) if key + REVERSE in self.functions else slice(None)


def _checked(axes_mm: ArrayLike, direction: ArrayLike | None) -> tuple[F2, F2]:
    axes = axes_positions(axes_mm)
    signs: F2 = np.zeros_like(axes) if direction is None else np.asarray(direction, dtype=np.float64)
    if signs.shape != axes.shape or not np.isin(signs, (-1.0, 0.0, 1.0)).all():
        raise ValueError(f"direction: expected -1, 0 or +1 in shape {axes.shape}, got shape {signs.shape}")
    return axes, signs
