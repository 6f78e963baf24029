"""Thermal growth of an axis: its screw or scale warms up and grows away from the fixed end."""

from __future__ import annotations

from abbe.models.arrays import F1, F3
from abbe.models.effects.columns import AXIS_KEYS, CAMPAIGN_S, STEEL_PER_K, along, axis_of, first, of_strokes, warmth, with_sensor
from abbe.models.effects.effect import Effect, Form, Parameter, Values
from abbe.models.effects.path import Path, Places

SHAPE = (
    Parameter("tau_s", "s", *CAMPAIGN_S, 3600.0, "usual range: 20 to 120 min", (900.0, 2500.0, 7000.0)),
    Parameter("fixed", "1", 0.0, 1.0, 0.0, "share of the stroke where the axis is held: mostly an end", (0.0, 0.5, 1.0)),
)
SLOW, FAST = 3.0, 1.0 / 3.0


def _from_fixed(path: Path, at: Places, key: str, values: Values) -> F1:
    """Return the distance from the fixed point, mm."""
    a = axis_of(key)
    low, high = (float(v) for v in path.machine.stroke_mm[a])
    return at.q_mm[:, a] - (low + values["fixed"] * (high - low))


def growth(path: Path, at: Places, key: str, values: Values) -> F3:
    """Return alpha (x - x_fixed) (1 - exp(-t / tau)) for a rise of 1 K."""
    return along(axis_of(key), STEEL_PER_K * _from_fixed(path, at, key, values) * warmth(at.t_s, values["tau_s"]))


def _second_time(path: Path, at: Places, key: str, values: Values) -> F3:
    """Return the change of the growth if a part warms up faster (nut) or more slowly (bed)."""
    x = STEEL_PER_K * _from_fixed(path, at, key, values)
    return along(axis_of(key), *(x * (warmth(at.t_s, values["tau_s"] * k) - warmth(at.t_s, values["tau_s"])) for k in (FAST, SLOW)))


def _uneven(path: Path, at: Places, key: str, values: Values) -> F3:
    """Return the growth of a screw that is hotter where the nut works; this growth is not proportional to the distance."""
    a = axis_of(key)
    low, high = (float(v) for v in path.machine.stroke_mm[a])
    x = (at.q_mm[:, a] - low) / (high - low)
    shape = STEEL_PER_K * (high - low) * (x**2 - x)
    return along(a, shape * warmth(at.t_s, values["tau_s"]))


def _sensed(path: Path, at: Places, key: str, values: Values, rise_k: F1) -> F3:
    """Return the growth that follows from the temperature sensor of the axis."""
    return along(axis_of(key), STEEL_PER_K * _from_fixed(path, at, key, values) * rise_k)


EFFECT = Effect(
    name="axis_thermal_growth",
    title="thermal growth of an axis",
    family="thermal",
    keys=AXIS_KEYS,
    unit="K",
    per_unit=1.0,
    typical=(1.0, 8.0),
    shape=SHAPE,
    signal=of_strokes(growth),
    strength=first,
    forms=(
        Form("second time constant", of_strokes(_second_time)),
        Form("uneven", of_strokes(_uneven)),
        Form("sensor", with_sensor(_sensed, str.lower)),
    ),
    needs="an early run repeated late; two origins on the axis",
    signature="the scale of the axis changes from run to run as the machine warms up",
    remedy="warm up or sensor",
    remedy_text="warm the axis up before work, or let the control correct its scale by a temperature sensor; a glass scale cures it",
    source="ISO 230-3; local heating of a ball screw in semi-closed loop",
    separated_by={
        "axis_thermal_growth": ("longer_session", "single_axis_laser"),
        "spindle_thermal_drift": ("laser_diagonals", "longer_session", "single_axis_laser"),
        "squareness_thermal": ("laser_diagonals", "longer_session"),
        "air_refraction": ("ballbar", "longer_session"),
        "bar_thermal": ("laser_diagonals", "longer_session"),
        "laser_cosine": ("longer_session", "second_radius"),
    },
)
