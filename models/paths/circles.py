"""Circles and arcs on the ball-bar's sphere (ISO 230-4), and the ways into a path, out of it, and from another one."""

from __future__ import annotations

from typing import Literal

import numpy as np

from abbe.models.arrays import F1, F2

Plane = Literal["XY", "YZ", "ZX"]
PLANES: tuple[Plane, ...] = ("XY", "YZ", "ZX")
FAR_RAD = np.deg2rad(150.0)
"""Two points farther apart have no good short way between them: by way of the pole the path stays clear of the cup."""
LOW_RAD = np.deg2rad(30.0)
VERY_LOW = 0.7
"""Below the equator by more than this share of the radius even a short way may pass the foot of the cup."""


def circle_points(centre_mm: F1, radius_mm: float, plane: Plane, angles_rad: F1) -> F2:
    """Points of a circle in a plane of two axes at given angles, counted from the plane's first axis to its second.

    Parameters
    ----------
    centre_mm : array, shape (3,)
    plane : "XY", "YZ" or "ZX"
    angles_rad : array, shape (n,)

    Returns
    -------
    array, shape (n, 3), mm, in the frame of ``centre_mm``.

    Raises
    ------
    ValueError
        Another plane, radius not positive, or a centre that is not three finite numbers.
    """
    if plane not in PLANES:
        raise ValueError(f"circle: plane {plane!r} must be XY, YZ or ZX")
    if not 0 < radius_mm < np.inf or np.shape(centre_mm) != (3,) or not np.isfinite(centre_mm).all():
        raise ValueError("circle: radius must be positive and the centre three finite numbers")
    out: F2 = np.tile(np.asarray(centre_mm, dtype=np.float64), (len(angles_rad), 1))
    a, b = ("XYZ".index(c) for c in plane)
    out[:, a] += radius_mm * np.cos(angles_rad)
    out[:, b] += radius_mm * np.sin(angles_rad)
    return out


def arc_through(centre_mm: F1, at_mm: F1, along: F1, angles_rad: F1) -> F2:
    """Points of the great circle that passes ``at_mm`` in the direction ``along``; angles count from there, negative ones before it.

    Joined to a path that goes through ``at_mm`` in that direction, it enters (or leaves) the path without a corner and stays on the
    sphere, so that a bar that hangs in keeps its length.

    Parameters
    ----------
    centre_mm, at_mm : array, shape (3,)
        Centre of the sphere; a point on it.
    along : array, shape (3,)
        Direction of motion there; what of it leaves the sphere does not count.
    angles_rad : array, shape (n,)

    Returns
    -------
    array, shape (n, 3), mm.

    Raises
    ------
    ValueError
        The point is the centre, or the direction has no part along the sphere.
    """
    out = np.asarray(at_mm, dtype=np.float64) - centre_mm
    radius = float(np.linalg.norm(out))
    if not radius > 0.0:
        raise ValueError("arc: the point is the sphere's centre")
    out = out / radius
    tangent = np.asarray(along, dtype=np.float64) - out * float(np.dot(along, out))
    size = float(np.linalg.norm(tangent))
    if not size > 1e-12:
        raise ValueError("arc: the direction does not run along the sphere")
    tangent = tangent / size
    return np.asarray(centre_mm + radius * (np.outer(np.cos(angles_rad), out) + np.outer(np.sin(angles_rad), tangent)))


def way_on_sphere(centre_mm: F1, start_mm: F1, end_mm: F1, up: F1, chord_mm: float) -> F2:
    """Points of a way on the sphere from one of its points to another, at most about ``chord_mm`` apart, both ends included.

    The short great circle; by way of the pole where the points are nearly opposite, or one of them is low and the way is long: there the
    short way could lead under the cup.

    Parameters
    ----------
    up : array, shape (3,)
        Unit vector from the centre to the pole, where the spindle is.
    """
    a, b = (np.asarray(p, dtype=np.float64) - centre_mm for p in (start_mm, end_mm))
    radius = float(np.linalg.norm(a))
    angle = _angle(a, b)
    lowest = min(float(a @ up), float(b @ up)) / radius
    if angle > FAR_RAD or (lowest < -0.02 and angle > LOW_RAD) or lowest < -VERY_LOW:
        pole = centre_mm + radius * np.asarray(up)
        first, second = _short(centre_mm, start_mm, pole, chord_mm), _short(centre_mm, pole, end_mm, chord_mm)
        return np.concatenate([first, second[1:]])
    return _short(centre_mm, start_mm, end_mm, chord_mm)


def _short(centre_mm: F1, start_mm: F1, end_mm: F1, chord_mm: float) -> F2:
    start, end = (np.asarray(p, dtype=np.float64) for p in (start_mm, end_mm))
    a, b = start - centre_mm, end - centre_mm
    angle = _angle(a, b)
    n = max(1, int(np.ceil(angle * float(np.linalg.norm(a)) / chord_mm)))
    if angle < 1e-9:
        return np.stack([start, end])
    if angle > np.pi - 1e-6:
        b = b + 1e-3 * float(np.linalg.norm(b)) * _across(b)
        angle = _angle(a, b)
    inner = arc_through(centre_mm, start, b - a, np.linspace(0.0, angle, n + 1))
    return np.concatenate([start[None], inner[1:-1], end[None]])


def _angle(a: F1, b: F1) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def _across(v: F1) -> F1:
    helper = np.eye(3)[int(np.argmin(np.abs(v)))]
    out = np.cross(v, helper)
    return np.asarray(out / np.linalg.norm(out))
