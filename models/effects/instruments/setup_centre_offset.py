"""Offset of the cup's centre: actual position of the cup minus the position at which the spindle set it."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F2
from abbe.models.effects.columns import NO_KEY, UM, per_setup, setup_length
from abbe.models.effects.effect import Effect, Values
from abbe.models.effects.path import Path


def offset(path: Path, values: Values) -> F2:
    """Return minus the bar's direction for an offset of 1 um in X, Y, Z: three coefficients per ball-bar set-up."""
    return np.asarray(-UM * path.look)


EFFECT = Effect(
    name="setup_centre_offset",
    title="offset of the ball-bar's centre",
    family="instrument",
    keys=NO_KEY,
    unit="um",
    per_unit=1.0,
    typical=(0.3, 30.0),
    shape=(),
    signal=per_setup("bar", 3, offset),
    strength=setup_length(3),
    needs="nothing: every ball-bar run shows it",
    signature="one wave per revolution, with another amplitude and direction in every set-up",
    remedy="set-up",
    remedy_text="not an error of the machine: let it be fitted as an unknown of the set-up",
    source="ISO 230-4; usual model: a constant vector per set-up",
    absorbed_by=("setup_centre_offset",),
    blind=("laser_diagonal", "laser_linear"),
    separated_by={"spindle_thermal_drift": ("longer_session",), "backlash": ("opposite_direction",)},
)
