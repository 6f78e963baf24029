"""Hemispherical helices of the ball-bar test (math.md 4.3)."""

from __future__ import annotations

from typing import Literal

import numpy as np

from models.arrays import F1, F2

Law = Literal["angle", "area"]


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
    array, shape (n, 3), mm. For ``axis`` 1: O + R (sin f cos t, cos f, sin f sin t).
    """
    if n < 2 or radius_mm <= 0 or not 0 < span_rad <= np.pi / 2:
        raise ValueError("helix: n must be 2 or more, radius positive, span within (0, pi/2]")
    k = np.linspace(0.0, 1.0, n)
    phi = span_rad * k if law == "angle" else np.arccos(1.0 - k * (1.0 - np.cos(span_rad)))
    theta = 2 * np.pi * turns * k
    a, b = (0, 2) if axis == 1 else ((axis + 1) % 3, (axis + 2) % 3)
    out = np.empty((n, 3))
    out[:, axis] = np.cos(phi)
    out[:, a] = np.sin(phi) * np.cos(theta)
    out[:, b] = np.sin(phi) * np.sin(theta)
    return np.asarray(centre_mm) + radius_mm * out
