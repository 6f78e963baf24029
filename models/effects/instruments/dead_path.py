"""Dead path: drifting air in the part of the beam that the mirror never travels shifts the laser's zero."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F2
from abbe.models.effects.columns import AIR_PER_K, NO_KEY, first, of_kind
from abbe.models.effects.effect import Effect, Form, Values
from abbe.models.effects.path import Path


def _hours(path: Path) -> F2:
    return np.asarray((path.at.t_s - path.reference.t_s[0]) / 3600.0)[:, None]


def zero_drift(path: Path, key: str, values: Values) -> F2:
    """Return the error for air that warms by 1 K/h: -0.93e-6 per K times the dead path times the rise since the first record."""
    return np.asarray(AIR_PER_K * path.dead_path_mm * _hours(path))


def _bent(path: Path, key: str, values: Values) -> F2:
    """Return a drift that grows with the square of the time, not linearly."""
    return np.asarray(AIR_PER_K * path.dead_path_mm * _hours(path) ** 2)


EFFECT = Effect(
    name="dead_path",
    title="drift of the laser's dead path",
    family="instrument",
    keys=NO_KEY,
    unit="K/h",
    per_unit=1.0,
    typical=(1.0, 8.0),
    shape=(),
    signal=of_kind("laser", zero_drift, 1),
    strength=first,
    forms=(Form("bent", of_kind("laser", _bent, 1)),),
    needs="a diagonal out and back, which separates time from position",
    signature="the reading drifts during a run at every position, down while the air warms up (above 0 K/h): forth and back make a loop",
    remedy="set-up",
    remedy_text="bring the interferometer near the start of the travel, shield the beam, set the zero when the air has settled",
    source="usual model: linear drift; Edlen: -0.93 ppm/K",
    blind=("ballbar_helix", "ballbar_circle"),
    separated_by={
        "backlash": ("opposite_direction", "ballbar"),
        "axis_thermal_growth": ("ballbar", "longer_session"),
        "spindle_thermal_drift": ("ballbar",),
    },
)
