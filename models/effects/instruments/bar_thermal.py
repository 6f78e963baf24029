"""Thermal state of the ball-bar: a bar warmed by the hand is too long at first and shrinks back to its length."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F2
from abbe.models.effects.columns import NO_KEY, STEEL_PER_K, first, of_kind, per_setup
from abbe.models.effects.effect import Effect, Form, Parameter, Values
from abbe.models.effects.path import Path

HANDLED_K = 0.05
"""Unit of the differences between the set-ups, K: so small that the strength remains their common excess."""


def _cooling(path: Path, tau_s: float) -> F2:
    since_s = np.maximum(path.at.t_s - path.t_set_s, 0.0)
    return np.asarray(-STEEL_PER_K * path.radius_mm * np.exp(-since_s / tau_s))[:, None]


def relaxing(path: Path, key: str, values: Values) -> F2:
    """Return -alpha R exp(-(t - t_set) / tau) for 1 K: a longer bar between the same two balls reads less."""
    return _cooling(path, values["tau_s"])


def _second_time(path: Path, key: str, values: Values) -> F2:
    now = _cooling(path, values["tau_s"])
    return np.concatenate([_cooling(path, values["tau_s"] / 3.0) - now, _cooling(path, values["tau_s"] * 3.0) - now], axis=1)


def _handled(path: Path, values: Values) -> F2:
    """Return the same reading for an excess of `HANDLED_K`: every set-up is handled anew, so each begins with another excess."""
    return HANDLED_K * _cooling(path, values["tau_s"])


EFFECT = Effect(
    name="bar_thermal",
    title="thermal state of the ball-bar",
    family="instrument",
    keys=NO_KEY,
    unit="K",
    per_unit=1.0,
    typical=(1.0, 6.0),
    shape=(Parameter("tau_s", "s", 150.0, 4000.0, 900.0, "minutes after handling", (250.0, 600.0, 1500.0)),),
    signal=of_kind("bar", relaxing, 1),
    strength=first,
    forms=(Form("per set-up", per_setup("bar", 1, _handled)), Form("second time constant", of_kind("bar", _second_time, 2))),
    needs="several runs per set-up, spread over ten minutes and more",
    signature="all readings of a set-up relax together from the moment it was mounted",
    remedy="set-up",
    remedy_text="let the bar lie by the machine before the test, handle it with gloves, wait some minutes after mounting",
    source="usual model: exponential decay; steel grows by 11.5 ppm/K",
    blind=("laser_diagonal", "laser_linear"),
    separated_by={
        "bar_length_error": ("longer_session", "second_radius"),
        "axis_thermal_growth": ("laser_diagonals", "longer_session"),
        "contour_lag": ("second_feed", "longer_session"),
    },
)
