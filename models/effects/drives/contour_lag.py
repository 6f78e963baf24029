"""Contour lag: all axes follow late by the same time, so a circle becomes too small, and smaller at a higher feed."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.effects.columns import NO_KEY, of_kind
from abbe.models.effects.effect import Effect, Form, Values
from abbe.models.effects.path import Path

MS2 = 1e-6


def inward(path: Path, key: str, values: Values) -> F2:
    """Return -tau^2 v^2 / (2 R) for a lag tau of 1 ms; the coefficient is the square of the lag in ms^2.

    A lag tau moves the tool by -tau v + tau^2 a. On a path around the cup with bar direction u, u.v = 0 and u.a = -v^2 / R; the sideways
    displacement tau v lengthens the bar by tau^2 v^2 / (2 R), half as much as the inward part shortens it.
    """
    speed_squared = (path.at.v_mm_s**2).sum(axis=1)
    return np.asarray(-MS2 * speed_squared / (2.0 * path.radius_mm))[:, None]


def _off_centre(path: Path, key: str, values: Values) -> F2:
    """Return -tau u.v for tau = 1 ms: on a path about a cup off the nominal centre, a lag looks like a servo mismatch.

    ``path.look`` must be the actual direction of the bar; with the nominal direction the column is zero.
    """
    return np.asarray(-1e-3 * np.einsum("ni,ni->n", path.look, path.at.v_mm_s))[:, None]


def strength(coefficients: F1, values: Values) -> float:
    """Return the lag in ms; negative if the circle grows instead of shrinking."""
    c = float(coefficients[0])
    return float(np.sign(c) * np.sqrt(abs(c)))


EFFECT = Effect(
    name="contour_lag",
    title="contour lag (finite position gain)",
    family="drive",
    keys=NO_KEY,
    unit="ms",
    per_unit=1.0,
    typical=(8.0, 25.0),
    shape=(),
    signal=of_kind("bar", inward, 1),
    strength=strength,
    forms=(Form("off centre", of_kind("bar", _off_centre, 1)),),
    needs="ball-bar runs with at least two feeds",
    signature="the radius shrinks with the square of the feed, equally in all directions and at all places",
    remedy="control parameter",
    remedy_text="raise the position gain of all axes together or switch on velocity feed-forward; meanwhile finish at a low feed",
    source="usual model: -tau^2 v^2 / (2 R)",
    blind=("laser_diagonal", "laser_linear"),
    separated_by={
        "laser_cosine": ("second_feed",),
        "bar_length_error": ("second_feed",),
        "bar_thermal": ("second_feed", "longer_session"),
        "servo_mismatch": ("second_feed", "opposite_direction"),
        "axis_thermal_growth": ("second_feed",),
    },
)
