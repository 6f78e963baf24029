"""Contour lag: all axes follow late by the same time, so a circle becomes too small, more so at a higher feed."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.effects.columns import NO_KEY, of_kind
from abbe.models.effects.effect import Effect, Form, Values
from abbe.models.effects.path import Path

MS2 = 1e-6


def inward(path: Path, key: str, values: Values) -> F2:
    """-v^2 / (2 R) at a lag of 1 ms; the coefficient is the lag's square in ms^2.

    A lag tau moves the tool by -tau v + tau^2 a. On a path around the cup u.v = 0 and u.a = -v^2 / R, and the sideways tau v lengthens the
    bar by tau^2 v^2 / (2 R); what is left is half of the inward part.
    """
    speed_squared = (path.at.v_mm_s**2).sum(axis=1)
    return np.asarray(-MS2 * speed_squared / (2.0 * path.radius_mm))[:, None]


def _off_centre(path: Path, key: str, values: Values) -> F2:
    """-tau u.v, 1 ms: zero on a circle about the cup; what a cup beside the centre makes of the lag looks like a servo mismatch.

    It needs a path whose ``look`` is the bar's real direction; with the nominal one the column is zero but for rounding.
    """
    return np.asarray(-1e-3 * np.einsum("ni,ni->n", path.look, path.at.v_mm_s))[:, None]


def strength(coefficients: F1, values: Values) -> float:
    """Lag in ms; negative where the circle grows instead of shrinking."""
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
    signature="the radius shrinks with the square of the feed, alike in all directions and at all places",
    remedy="control parameter",
    remedy_text="raise the position gain of all axes together or switch on velocity feed-forward; meanwhile finish at a low feed",
    source="effects.md 1: -tau^2 v^2 / (2 R)",
    blind=("laser_diagonal", "laser_linear"),
    separated_by={
        "laser_cosine": ("second_feed",),
        "bar_length_error": ("second_feed",),
        "bar_thermal": ("second_feed", "longer_session"),
        "servo_mismatch": ("second_feed", "opposite_direction"),
        "axis_thermal_growth": ("second_feed",),
    },
)
