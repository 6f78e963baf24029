"""Refraction of air: the wavelength of the laser follows the temperature and pressure of the air."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F2
from abbe.models.effects.columns import AIR_PER_K, NO_KEY, amplitude, of_kind, rise_of, spread
from abbe.models.effects.effect import Effect, Form, Parameter, Values
from abbe.models.effects.path import Path


def _waves(path: Path, period_s: float) -> F2:
    phase = 2.0 * np.pi * path.at.t_s / period_s
    return np.asarray(AIR_PER_K * path.travel_mm[:, None] * np.column_stack([np.sin(phase), np.cos(phase)]))


def breathing(path: Path, key: str, values: Values) -> F2:
    """Return -0.93e-6 times the displacement times sine and cosine of the hall's temperature cycle, 1 K: warm air reads short."""
    return _waves(path, values["period_s"])


def _second(path: Path, key: str, values: Values) -> F2:
    return _waves(path, values["period_s"] / 2.0)


def _offset(path: Path, key: str, values: Values) -> F2:
    """Return the error for an offset of 1 K (the wavelength was set for air of another temperature) and for a drift of 1 K/h."""
    base = AIR_PER_K * path.travel_mm
    return np.column_stack([base, base * path.at.t_s / 3600.0])


def _sensed(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
    """Return the error that follows from the rise of the air sensor, K; zeros without this sensor."""
    rise = rise_of(paths, "air")
    return [np.zeros((p.n, 1)) if rise is None else np.asarray(AIR_PER_K * p.travel_mm * rise(p.at.t_s))[:, None] for p in paths]


EFFECT = Effect(
    name="air_refraction",
    title="refraction of air",
    family="instrument",
    keys=NO_KEY,
    unit="K",
    per_unit=1.0,
    typical=(1.0, 6.0),
    shape=(Parameter("period_s", "s", 1500.0, 20000.0, 5400.0, "half an hour to a shift of heating", spread(2000.0, 16000.0, 9)),),
    signal=of_kind("laser", breathing, 2),
    strength=amplitude,
    forms=(
        Form("offset and drift", of_kind("laser", _offset, 2)),
        Form("second harmonic", of_kind("laser", _second, 2)),
        Form("sensor", _sensed),
    ),
    needs="laser runs far apart in time, or an air sensor",
    signature="the scale of the diagonals changes from set-up to set-up: short in warm air, 1 um per metre and kelvin",
    remedy="warm up or sensor",
    remedy_text="measure air temperature and pressure at the beam and let the laser's software correct the wavelength",
    source="Edlen: the reading changes by -0.93 ppm/K, +0.27 ppm/hPa",
    blind=("ballbar_helix", "ballbar_circle"),
    separated_by={
        "axis_thermal_growth": ("ballbar", "longer_session"),
        "laser_cosine": ("longer_session",),
        "nonrigid_bed": ("ballbar", "longer_session"),
    },
)
