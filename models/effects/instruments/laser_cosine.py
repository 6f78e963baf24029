"""Cosine error of the laser: the beam deviates from the nominal direction, which scales the whole displacement."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.effects.columns import NO_KEY, PPM, per_setup
from abbe.models.effects.effect import Effect, Values
from abbe.models.effects.path import Path


def scaled(path: Path, values: Values) -> F2:
    """Return half the displacement times 1 mrad^2; the coefficient of each laser set-up is theta^2 - 2 theta tilt in mrad^2.

    The error is of second order. It has one sign in all set-ups if all mirrors are aligned the same way: with mirrors square to the motion
    the laser always reads long, with mirrors square to the beam always short.
    """
    return np.asarray(0.5 * PPM * path.travel_mm)[:, None]


def strength(coefficients: F1, values: Values) -> float:
    """Return the misalignment in mrad from the mean coefficient of the set-ups; negative if the laser reads short.

    The mirror's tilt may contribute to a coefficient with either sign.
    """
    nonzero = coefficients[coefficients != 0.0]
    mean = float(nonzero.mean()) if nonzero.size else 0.0
    return float(np.sign(mean) * np.sqrt(abs(mean)))


EFFECT = Effect(
    name="laser_cosine",
    title="cosine error of the laser beam",
    family="instrument",
    keys=NO_KEY,
    unit="mrad",
    per_unit=1.0,
    typical=(1.0, 5.0),
    shape=(),
    signal=per_setup("laser", 1, scaled),
    one_sign=True,
    strength=strength,
    needs="a ball-bar scale as reference: with a laser alone this error is part of the axes' scales",
    signature="a scale error of each diagonal, constant over time and direction of motion",
    remedy="set-up",
    remedy_text="align the beam again over the full travel before the next diagonal",
    source="Wang: 1 mrad makes 0.5 um/m",
    blind=("ballbar_helix", "ballbar_circle"),
    separated_by={
        "contour_lag": ("second_feed",),
        "bar_length_error": ("reference_length", "second_radius"),
        "axis_thermal_growth": ("longer_session", "second_radius"),
        "air_refraction": ("longer_session",),
    },
)
