"""Length error of the ball-bar: the bar's actual length differs from its certificate."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F2
from abbe.models.effects.columns import NO_KEY, UM, first, of_kind
from abbe.models.effects.effect import Effect, Form, Values
from abbe.models.effects.path import Path


def constant(path: Path, key: str, values: Values) -> F2:
    """Return +1 um for every ball-bar reading."""
    return np.full((path.n, 1), UM)


def _with_radius(path: Path, key: str, values: Values) -> F2:
    """Return the part of the error that is proportional to the length of the bar, 1 um per 100 mm."""
    return np.full((path.n, 1), UM * path.radius_mm / 100.0)


EFFECT = Effect(
    name="bar_length_error",
    title="length error of the ball-bar",
    family="instrument",
    keys=NO_KEY,
    unit="um",
    per_unit=1.0,
    typical=(1.0, 15.0),
    shape=(),
    signal=of_kind("bar", constant, 1),
    strength=first,
    forms=(Form("with radius", of_kind("bar", _with_radius, 1)),),
    needs="two radii, or laser diagonals",
    signature="the same constant in all ball-bar readings, at all feeds and places",
    remedy="set-up",
    remedy_text="calibrate the bar on its reference, or let its length be fitted",
    source="usual model: a constant",
    absorbed_by=("bar_length_error",),
    blind=("laser_diagonal", "laser_linear"),
    separated_by={
        "contour_lag": ("second_feed",),
        "laser_cosine": ("reference_length", "second_radius"),
        "bar_thermal": ("longer_session", "second_radius"),
        "axis_thermal_growth": ("longer_session",),
    },
)
