"""Straightness: a carriage leaves its straight line sideways, as a smooth function of its own position."""

from __future__ import annotations

from abbe.models.effects.columns import LATERAL_KEYS, WITH_LINE, direction_of, finer_shifts, rms, shifts
from abbe.models.effects.effect import Effect

EFFECT = Effect(
    name="straightness",
    title="straightness of an axis",
    family="geometry",
    keys=LATERAL_KEYS,
    unit="um",
    per_unit=1.0,
    typical=(1.0, 15.0),
    shape=(),
    signal=shifts(direction_of, 2, 6),  # the present model contains order 1, the squareness
    strength=rms,
    forms=finer_shifts(direction_of),
    unseen=WITH_LINE,
    needs="at least two positions of the other axes, to separate it from angular errors",
    signature="a smooth bow over the axis, the same at all positions of the other axes",
    remedy="table",
    remedy_text="enter it as straightness compensation over the axis; realign the guide if it is large",
    source="ISO 230-1; Pahk",
    absorbed_by=("rigid21",),
    separated_by={
        "angular_error": ("second_tool_length", "angular_interferometer"),
        "ram_sag": ("laser_diagonals", "second_radius"),
        "nonrigid_bed": ("laser_diagonals", "second_radius"),
        "lateral_play": ("opposite_direction",),
        "straightness": ("planar_circles", "ballbar"),
        "backlash": ("opposite_direction",),
    },
)
