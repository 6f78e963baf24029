"""All effects that Abbe knows by name."""

from __future__ import annotations

from abbe.models.effects.drives import (
    backlash,
    backlash_position_dependent,
    contour_lag,
    cyclic_error,
    reversal_spike,
    servo_mismatch,
    stick_slip,
    vibration,
)
from abbe.models.effects.effect import Effect
from abbe.models.effects.geometry import angular_error, positioning_nonlinear, straightness
from abbe.models.effects.instruments import (
    air_refraction,
    bar_length_error,
    bar_thermal,
    beam_outliers,
    dead_path,
    laser_cosine,
    mirror_tilt,
    setup_centre_offset,
)
from abbe.models.effects.structure import lateral_play, nonrigid_bed, ram_sag
from abbe.models.effects.thermal import axis_thermal_growth, spindle_thermal_drift, squareness_thermal

CATALOGUE: tuple[Effect, ...] = (
    backlash.EFFECT,
    backlash.BEGUN,
    backlash_position_dependent.EFFECT,
    reversal_spike.EFFECT,
    cyclic_error.EFFECT,
    cyclic_error.SECOND,
    servo_mismatch.EFFECT,
    contour_lag.EFFECT,
    stick_slip.EFFECT,
    vibration.EFFECT,
    lateral_play.EFFECT,
    nonrigid_bed.EFFECT,
    ram_sag.EFFECT,
    straightness.EFFECT,
    positioning_nonlinear.EFFECT,
    angular_error.EFFECT,
    axis_thermal_growth.EFFECT,
    spindle_thermal_drift.EFFECT,
    squareness_thermal.EFFECT,
    bar_thermal.EFFECT,
    setup_centre_offset.EFFECT,
    bar_length_error.EFFECT,
    mirror_tilt.EFFECT,
    laser_cosine.EFFECT,
    air_refraction.EFFECT,
    dead_path.EFFECT,
    beam_outliers.EFFECT,
    beam_outliers.BAR,
)
