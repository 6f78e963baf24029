"""Displacement (R − I) v of a vector v by a small rotation R, computed without R, so that no subtraction of long vectors loses digits.

Three forms make a rotation from E = (EA, EB, EC) (docs/explanation/conventions.md, "Exact kinematics"). They agree to first order.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import factorial
from typing import Literal

import numpy as np

from abbe.models.arrays import F1, F2, F3

RotationForm = Literal["vector", "zyx", "small"]


def cross(a: F2, b: F2) -> F2:
    """Return the cross product over the last axis of two arrays (..., 3) that broadcast, in a third of the time of `numpy.cross`."""
    out = np.empty(np.broadcast(a, b).shape, dtype=np.result_type(a, b))
    out[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    out[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    out[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return out


def rotation_factors(angle_squared: F1) -> tuple[F1, F1]:
    """Return Rodrigues' factors sin|E|/|E| and (1 − cos|E|)/|E|² from |E|² (rad²), also at |E| = 0."""
    angle = np.sqrt(angle_squared)
    angle = np.where(angle == 0.0, 1e-20, angle)  # small enough for sin(x) = x
    half = np.sin(0.5 * angle) / angle
    return np.asarray(np.sin(angle) / angle), np.asarray(2.0 * half * half)


S_SERIES = tuple((-1.0) ** n * 2 * n / factorial(2 * n + 1) for n in range(10, 0, -1))
C_SERIES = tuple((-1.0) ** n * 2 * n / factorial(2 * n + 2) for n in range(10, 0, -1))
"""Power series in |E|² of the results of `factor_slopes`, highest power first."""


def factor_slopes(angle_squared: F1) -> tuple[F1, F1]:
    """Return the derivatives of Rodrigues' factors by |E|, divided by |E|; below 1 rad from power series, to avoid cancellation."""
    q = np.asarray(angle_squared, dtype=np.float64)
    near = np.minimum(q, 1.0)
    s_series, c_series = (np.polyval(series, near).astype(np.float64, copy=False) for series in (S_SERIES, C_SERIES))
    if q.size and q.max() < 1.0:
        return s_series, c_series
    s, c = rotation_factors(q)
    far = np.maximum(q, 1.0)
    return np.where(q < 1.0, s_series, (np.cos(np.sqrt(q)) - s) / far), np.where(q < 1.0, c_series, (s - 2.0 * c) / far)


def cross_matrix(v: F2) -> F3:
    """Return the matrices [v]× with [v]× u = v × u, shape (n, 3, 3)."""
    out = np.zeros((*v.shape, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., i, j], out[..., j, i] = -v[..., k], v[..., k]
    return out


def rotation_matrix(rotation_rad: F2) -> F3:
    """Return the matrices of the rotations by the vectors E, shape (n, 3, 3) for E of shape (n, 3)."""
    s, c = rotation_factors((rotation_rad * rotation_rad).sum(axis=-1))
    k = cross_matrix(rotation_rad)
    matrix: F3 = np.eye(3) + s[..., None, None] * k + c[..., None, None] * (k @ k)
    return matrix


def turn_vector_slope(rotation_rad: F2, v_mm: F2) -> F3:
    """Return the derivative of `turn_vector` with respect to the rotation vector, shape (n, 3 components, 3 of E), mm per rad.

    At E = 0 it is −[v]×, as in rule G.
    """
    square = (rotation_rad * rotation_rad).sum(axis=-1)
    (s, c), (ds, dc) = rotation_factors(square), factor_slopes(square)
    once = cross(rotation_rad, v_mm)
    along = ds[..., None] * once + dc[..., None] * cross(rotation_rad, once)
    turned = -cross_matrix(v_mm)
    slope: F3 = s[..., None, None] * turned + along[..., :, None] * rotation_rad[..., None, :]
    slope += c[..., None, None] * (cross_matrix(rotation_rad) @ turned - cross_matrix(once))
    return slope


def turn_vector(rotation_rad: F2, v_mm: F2) -> F2:
    """Return (R − I) v for the right-handed rotation by the vector E (angle |E|, axis E/|E|).

    Parameters
    ----------
    rotation_rad, v_mm : arrays, shape (n, 3)

    Returns
    -------
    array, shape (n, 3), mm
    """
    s, c = rotation_factors((rotation_rad * rotation_rad).sum(axis=-1))
    once = cross(rotation_rad, v_mm)
    added: F2 = s[..., None] * once + c[..., None] * cross(rotation_rad, once)
    return added


def turn_zyx(rotation_rad: F2, v_mm: F2, *, reverse: bool = False) -> F2:
    """Return (R − I) v for R = Rz(EC) Ry(EB) Rx(EA), or, with ``reverse``, for R = Rx(EA) Ry(EB) Rz(EC).

    The reverse R of the angles −E is the inverse of the other R of the angles E. Shapes are those of `turn_vector`.
    """
    added = np.zeros(np.broadcast(rotation_rad, v_mm).shape)
    for k in (2, 1, 0) if reverse else (0, 1, 2):
        u, w = (k + 1) % 3, (k + 2) % 3
        s, c1 = np.sin(rotation_rad[..., k]), 2.0 * np.sin(0.5 * rotation_rad[..., k]) ** 2
        a, b = v_mm[..., u] + added[..., u], v_mm[..., w] + added[..., w]
        added[..., u] -= c1 * a + s * b
        added[..., w] += s * a - c1 * b
    return added


def matrix_zyx(angles_deg: Sequence[float]) -> F2:
    """Return R = Rz Ry Rx of turns about x, then y, then z by three angles in degrees; 12 digits, so quarter turns are exact."""
    turned: F2 = np.eye(3) + turn_zyx(np.deg2rad(angles_deg)[None], np.eye(3))
    return np.round(turned.T, 12) + 0.0


def turn_small(rotation_rad: F2, v_mm: F2, *, reverse: bool = False) -> F2:
    """Return (R − I) v for the papers' matrix R = I + [E]×; with ``reverse``, for the exact inverse R = (I − [E]×)⁻¹.

    (I − [E]×)⁻¹ − I = ([E]× + [E]×²) / (1 + |E|²). Shapes are those of `turn_vector`.
    """
    once = cross(rotation_rad, v_mm)
    if not reverse:
        return once
    back: F2 = (once + cross(rotation_rad, once)) / (1.0 + (rotation_rad * rotation_rad).sum(axis=-1))[..., None]
    return back


def turned_by(rotation: RotationForm, rotation_rad: F2, v_mm: F2, *, work_side: bool) -> F2:
    """Return the displacement (R − I) v by a carriage with the ISO rotation E (tool relative to workpiece), in one of three forms.

    Parameters
    ----------
    rotation : "vector", "zyx" or "small"
        R: the rotation by the vector E; Rz(EC) Ry(EB) Rx(EA) of the carriage's own angles; or I + [E]× as in the papers.
    rotation_rad, v_mm : arrays, shape (n, 3)
    work_side : bool
        The own rotation of a work-side carriage is −E, and its transform is inverted exactly. For ``vector`` the inverse of −E is E, so the
        side makes no difference.

    Raises
    ------
    ValueError
        ``rotation`` has another value.
    """
    if rotation == "vector":
        return turn_vector(rotation_rad, v_mm)
    if rotation == "zyx":
        return turn_zyx(rotation_rad, v_mm, reverse=work_side)
    if rotation == "small":
        return turn_small(rotation_rad, v_mm, reverse=work_side)
    raise ValueError(f"rotation {rotation!r}: must be 'vector', 'zyx' or 'small'")
