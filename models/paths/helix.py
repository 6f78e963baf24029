"""Hemispherical helices of the ball-bar test (math.md 4.3)."""

from __future__ import annotations

from typing import Literal

import numpy as np

from abbe.models.arrays import F1, F2

Law = Literal["angle", "area"]
FINER, GROWS = 8, 0.2
"""The way along a curve is added up in pieces this much shorter than the distances of its points; these differ so much from their mean."""


def helix_points(
    centre_mm: F1, radius_mm: float, *, turns: float, n: int, law: Law = "angle", axis: int = 1, span_rad: float = np.pi / 2
) -> F2:
    """Points of a hemispherical helix from the pole to the equator.

    Parameters
    ----------
    centre_mm : array, shape (3,)
    radius_mm : float
    turns, n : float, int
        Turns about the hemisphere's axis and number of points, both ends included.
    law : "angle" | "area"
        ``angle``: colatitude grows uniformly (math.md 4.3); ``area``: cos(colatitude) falls uniformly, so that every band of the sphere
        gets points in proportion to its area.
    axis : int
        Axis of the hemisphere: 0 X, 1 Y (the paper's horizontal-spindle machine), 2 Z.
    span_rad : float
        Largest colatitude, pi/2 for the full hemisphere.

    Returns
    -------
    array, shape (n, 3), mm, in the frame of ``centre_mm``. For ``axis`` 1: O + R (sin f cos t, cos f, sin f sin t).

    Raises
    ------
    ValueError
        n < 2, radius not positive, turns not finite, span outside (0, pi/2], unknown law, axis not 0, 1 or 2, or a centre that is not three
        finite numbers. Fewer than three turns are drawn, though they determine little (math.md 4.5).
    """
    if n < 2 or not 0 < radius_mm < np.inf or not np.isfinite(turns) or not 0 < span_rad <= np.pi / 2:
        raise ValueError("helix: n must be 2 or more, radius positive, turns a number, span within (0, pi/2]")
    if law not in ("angle", "area"):
        raise ValueError(f"helix: law {law!r} must be 'angle' or 'area'")
    if axis not in (0, 1, 2):
        raise ValueError(f"helix: axis {axis} must be 0, 1 or 2")
    if np.shape(centre_mm) != (3,) or not np.isfinite(centre_mm).all():
        raise ValueError(f"helix: the centre must be three finite numbers, got {centre_mm!r}")
    return np.asarray(centre_mm) + radius_mm * _unit(np.linspace(0.0, 1.0, n), turns, law, axis, span_rad)


def even_helix_points(centre_mm: F1, radius_mm: float, *, turns: float, n: int, law: Law = "area", axis: int = 2) -> F2:
    """Points of the same curve at almost equal distances along it, growing from 0.8 to 1.2 of their mean.

    By the area law itself, points lie several times as far apart at the pole as elsewhere. All of one distance, driven at one feed, they
    would be passed with one frequency, like a vibration.

    Parameters, result, errors: as `helix_points`, for the full hemisphere.
    """
    fine = np.linspace(0.0, 1.0, FINER * n) ** 2  # the area law leaves the pole like a square root
    curve = _unit(fine, turns, law, axis, 0.5 * np.pi)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    ends = helix_points(centre_mm, radius_mm, turns=turns, n=2, law=law, axis=axis)
    even = np.linspace(0.0, 1.0, n)[1:-1]
    between = np.interp(along[-1] * even * (1.0 - GROWS + GROWS * even), along, fine)
    inner = np.asarray(centre_mm) + radius_mm * _unit(between, turns, law, axis, 0.5 * np.pi)
    return np.concatenate([ends[:1], inner, ends[1:]])


def _unit(share: F1, turns: float, law: Law, axis: int, span_rad: float) -> F2:
    """Where a helix of radius 1 about the origin is at shares 0..1 of its turns, shape (n, 3)."""
    phi = span_rad * share if law == "angle" else np.arccos(1.0 - share * (1.0 - np.cos(span_rad)))
    theta = 2 * np.pi * turns * share
    a, b = (0, 2) if axis == 1 else ((axis + 1) % 3, (axis + 2) % 3)
    out = np.empty((len(share), 3))
    out[:, axis] = np.cos(phi)
    out[:, a] = np.sin(phi) * np.cos(theta)
    out[:, b] = np.sin(phi) * np.sin(theta)
    return out


def helix_points_likely_code(centre_mm: F1, radius_mm: float, *, turns: float) -> F2:
    """The 63 points that the paper's own program probably made: t = 0, 0.1, .. 6.2, colatitude t / 4, longitude ``turns`` t (math.md 4.3).

    ``t = 0:0.1:2*pi`` has exactly the 63 samples of the paper and stops 0.021 rad of colatitude above the equator; it cannot be proved.

    Parameters, result: as `helix_points` with ``axis`` 1, shape (63, 3), mm.

    Raises
    ------
    ValueError
        Radius not positive, or turns not finite.
    """
    if not 0 < radius_mm < np.inf or not np.isfinite(turns):
        raise ValueError("helix: radius must be positive and turns a number")
    t = 0.1 * np.arange(63)
    phi, theta = t / 4.0, turns * t
    unit = np.stack([np.sin(phi) * np.cos(theta), np.cos(phi), np.sin(phi) * np.sin(theta)], axis=1)
    return np.asarray(np.asarray(centre_mm) + radius_mm * unit)
