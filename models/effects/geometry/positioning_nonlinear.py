"""Non-linear positioning error: a smooth deviation along an axis as a function of its own position."""

from __future__ import annotations

from abbe.models.effects.columns import AXIS_KEYS, WITH_LINE, axis_of, finer_shifts, rms, shifts
from abbe.models.effects.effect import Effect

EFFECT = Effect(
    name="positioning_nonlinear",
    title="non-linear positioning of an axis",
    family="geometry",
    keys=AXIS_KEYS,
    unit="um",
    per_unit=1.0,
    typical=(1.0, 20.0),
    shape=(),
    signal=shifts(axis_of, 2, 6),  # the present model contains order 1, the scale
    strength=rms,
    forms=finer_shifts(axis_of),
    unseen=WITH_LINE,
    needs="two positions of the other axes, to separate it from angular errors; several places on the axis",
    signature="a smooth curve of the deviation along the axis, the same at all positions of the other axes",
    remedy="table",
    remedy_text="enter it as screw (pitch) error compensation of the axis",
    source="Pahk: positioning bands of 6 to 71 um",
    absorbed_by=("rigid21",),
    separated_by={
        "angular_error": ("second_tool_length", "angular_interferometer"),
        "cyclic_error": ("single_axis_laser",),
        "straightness": ("planar_circles", "ballbar"),
        "positioning_nonlinear": ("single_axis_laser",),
    },
)
