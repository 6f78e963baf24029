"""Change of datum: which axis' line, and which plane, squareness is stated from.

The angles between the axes belong to the machine, the datum to the paper: ISO 230-1 and Wang start at the X line, Pahk at the Y line, Yang
and Kim at the Z line (math.md 1). Going from one to another is a rigid rotation: it changes every raw deviation and no distance. A datum is
written as two letters: the axis whose line keeps its nominal direction, and a second axis, kept in the nominal plane of the two: ``"XY"``
is ISO's, ``"YX"`` Pahk's, ``"ZX"`` Yang's.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from abbe.models.arrays import F1, F2
from abbe.models.geometry.rotation import turn_vector
from abbe.models.machine import AXES

_ISO_SIGN = np.array([1.0, -1.0, 1.0])
"""θ_XY = +C0Y, θ_XZ = −B0Z, θ_YZ = +A0Z, all obtuse positive (docs/explanation/conventions.md)."""

PARALLEL = 1e-9
"""Sine of an angle between two lines below which they make no plane; six digits of the plane's direction are left there."""


@dataclass(frozen=True, slots=True)
class DatumChange:
    """Lines of the axes seen from another datum.

    Parameters
    ----------
    lines : array, shape (3, 3)
        Unit directions of the X, Y, Z line, one per row, in the new frame.
    rotation_rad : array, shape (3,)
        Rotation vector that brings the old lines, and everything else, to the new ones; right-handed.
    """

    lines: F2
    rotation_rad: F1


def _order(datum: str) -> tuple[int, int, int]:
    """Axis indices: first, second, third."""
    if len(datum) != 2 or datum[0] == datum[1] or not set(datum) <= set(AXES):
        raise ValueError(f"datum {datum!r}: must be two different letters of X, Y, Z: the line, then the axis that makes the plane")
    a, b = (AXES.index(c) for c in datum)
    return a, b, 3 - a - b


def _obtuse(squareness_rad: F1) -> F2:
    """θ of every pair of axes, symmetric, shape (3, 3)."""
    angles = np.asarray(squareness_rad, dtype=np.float64)
    if angles.shape != (3,) or not (np.abs(angles) < 0.5).all():
        raise ValueError(f"squareness: expected C0Y, B0Z, A0Z in rad, each below 0.5, got {angles.tolist()}")
    theta = np.zeros((3, 3))
    for (i, j), value in zip(combinations(range(3), 2), _ISO_SIGN * angles, strict=True):
        theta[i, j] = theta[j, i] = value
    return theta


def datum_slopes(squareness_rad: F1, datum: str = "XY") -> F2:
    """Straightness slopes by which the three lines carry the squareness, first order: translation of an axis = slope × its travel.

    Parameters
    ----------
    squareness_rad : array, shape (3,)
        C0Y, B0Z, A0Z.
    datum : str
        ``"XY"``: the Y line runs (−C0Y, 1, 0), the Z line (B0Z, −A0Z, 1); ``"YX"`` Pahk's X line (1, −α, 0), ``"ZX"`` Yang's X line
        (1, 0, −Sxz) and Y line (−Sxy, 1, −Syz).

    Returns
    -------
    array, shape (3 axes, 3 components)
        To be added as ``motions[:, j, :3] += slopes[j] * travel_j``.

    Raises
    ------
    ValueError
        No datum, or not three angles.
    """
    first, second, third = _order(datum)
    theta = _obtuse(squareness_rad)
    slopes = np.zeros((3, 3))
    slopes[second, first] = -theta[second, first]
    slopes[third, [first, second]] = -theta[third, [first, second]]
    return slopes


def lines_from_squareness(squareness_rad: F1, datum: str = "XY") -> F2:
    """Exact unit directions of the three lines: the angle between any two is 90° + θ, not only to first order.

    Parameters, errors as in `datum_slopes`.

    Returns
    -------
    array, shape (3, 3): X, Y, Z line, one per row.
    """
    first, second, third = _order(datum)
    dot = -np.sin(_obtuse(squareness_rad))
    lines = np.zeros((3, 3))
    lines[first, first] = 1.0
    lines[second, first] = dot[second, first]
    lines[second, second] = np.sqrt(1.0 - dot[second, first] ** 2)
    a = dot[third, first]
    b = (dot[third, second] - a * lines[second, first]) / lines[second, second]
    lines[third, [first, second, third]] = a, b, np.sqrt(1.0 - a * a - b * b)
    return lines


def squareness_from_lines(lines: F2) -> F1:
    """C0Y, B0Z, A0Z (rad, shape (3,)) of three directions, in whatever frame: only the angles between them count.

    Parameters
    ----------
    lines : array, shape (3, 3)
        Directions of the X, Y, Z line towards plus, one per row, any length, e.g. fitted to the measured path of the tool.

    Raises
    ------
    ValueError
        Another shape, a number that is not finite, or a row without length.
    """
    unit = _unit_rows(lines)
    theta = [-np.arcsin(np.clip(unit[i] @ unit[j], -1.0, 1.0)) for i, j in combinations(range(3), 2)]
    return np.asarray(_ISO_SIGN * theta)


def _unit_rows(lines: F2) -> F2:
    rows = np.asarray(lines, dtype=np.float64)
    if rows.shape != (3, 3):
        raise ValueError(f"lines: expected three directions, shape (3, 3), got shape {rows.shape}")
    if not np.isfinite(rows).all():
        raise ValueError("lines: expected finite numbers")
    if not rows.any(axis=1).all():
        raise ValueError(f"lines: the {AXES[int(np.argmin(rows.any(axis=1)))]} line has no direction, it is zero")
    rows = rows / np.abs(rows).max(axis=1, keepdims=True)  # any length: its square must neither overflow nor vanish
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True))


def change_datum(lines: F2, datum: str) -> DatumChange:
    """Turn three lines into the frame of a datum: first line along its axis, second in the plane of the two.

    The angles between the lines, so the squareness, stay as they are. Take a deviation map along with `turned_deviation_mm`.

    Parameters
    ----------
    lines : array, shape (3, 3)
        X, Y, Z line, one per row, in any frame near the machine's.
    datum : str

    Raises
    ------
    ValueError
        No datum, no three directions, or the datum's two lines are parallel: then they make no plane.
    """
    first, second, third = _order(datum)
    unit = _unit_rows(lines)
    frame = np.zeros((3, 3))  # rows: where the axes of the new frame lie in the old one
    frame[first] = unit[first]
    across = unit[second] - (unit[second] @ unit[first]) * unit[first]
    if np.linalg.norm(across) < PARALLEL:
        raise ValueError(f"lines: the {AXES[first]} and the {AXES[second]} line are parallel and make no plane for datum {datum}")
    frame[second] = across / np.linalg.norm(across)
    handed = 1.0 if (first + 1) % 3 == second else -1.0
    frame[third] = handed * np.cross(frame[first], frame[second])
    return DatumChange(unit @ frame.T, np.asarray(Rotation.from_matrix(frame).as_rotvec()))


def turned_deviation_mm(points_mm: F2, deviation_mm: F2, rotation_rad: F1) -> F2:
    """A deviation map in the frame of another datum: the actual points turn about the origin by a finite rotation, the nominal ones stay.

    Parameters
    ----------
    points_mm, deviation_mm : arrays, shape (n, 3)
        Nominal positions and actual minus nominal.
    rotation_rad : array, shape (3,)
        `DatumChange.rotation_rad`.

    Returns
    -------
    array, shape (n, 3), mm. Distances between actual points are those of before, to rounding.
    """
    actual = np.asarray(points_mm, dtype=np.float64) + deviation_mm
    return np.asarray(deviation_mm + turn_vector(np.broadcast_to(rotation_rad, actual.shape), actual))
