"""Offset of the cup's centre: actual position of the cup minus the position at which the spindle set it."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F2
from abbe.models.effects.columns import NO_KEY, UM, per_setup, setup_length
from abbe.models.effects.effect import Effect
from abbe.models.effects.path import Path


def offset(path: Path) -> F2:
    """-u, 1 um in x, y, z: three coefficients per ball-bar set-up, set-ups in order of their names."""
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
    signature="one wave per turn, of another size and direction in every set-up",
    remedy="set-up",
    remedy_text="not an error of the machine: let it be fitted as an unknown of the set-up",
    source="effects.md 4",
    absorbed_by=("setup_centre_offset",),
    blind=("laser_diagonal", "laser_linear"),
    separated_by={"spindle_thermal_drift": ("longer_session",), "backlash": ("opposite_direction",)},
)
