"""Thermal drift of the spindle: head and spindle warm up and carry the tool away in one direction."""

from __future__ import annotations

from abbe.models.arrays import F1, F3
from abbe.models.effects.columns import AXIS_KEYS, CAMPAIGN_S, UM, WITH_SLOW, along, axis_of, first, of_places, warmth, with_sensor
from abbe.models.effects.effect import Effect, Form, Parameter, Values
from abbe.models.effects.path import Path, Places


def drift(at: Places, key: str, values: Values) -> F3:
    """Return 1 um times 1 - exp(-t / tau) along an axis; readings show only the change since the cup was set or the laser was zeroed."""
    return along(axis_of(key), UM * warmth(at.t_s, values["tau_s"]))


def _second_time(at: Places, key: str, values: Values) -> F3:
    slow, fast = (warmth(at.t_s, values["tau_s"] * k) - warmth(at.t_s, values["tau_s"]) for k in (3.0, 1.0 / 3.0))
    return along(axis_of(key), UM * fast, UM * slow)


def _sensed(path: Path, at: Places, key: str, values: Values, rise_k: F1) -> F3:
    """Return the drift that follows from the temperature of the spindle, 1 um per K."""
    return along(axis_of(key), UM * rise_k)


EFFECT = Effect(
    name="spindle_thermal_drift",
    title="thermal drift of the spindle",
    family="thermal",
    keys=AXIS_KEYS,
    unit="um",
    per_unit=1.0,
    typical=(5.0, 60.0),
    shape=(Parameter("tau_s", "s", *CAMPAIGN_S, 3600.0, "minutes to two hours", (900.0, 2500.0, 7000.0)),),
    signal=of_places(drift),
    strength=first,
    unseen=WITH_SLOW,
    forms=(Form("second time constant", of_places(_second_time)), Form("sensor", with_sensor(_sensed, lambda key: "spindle"))),
    needs="a long set-up without a new zero, early in the warm-up",
    signature="the centre drifts within one set-up, equally at all positions",
    remedy="warm up or sensor",
    remedy_text="warm up the spindle, cool the head, or let the control shift the axis by a spindle sensor; probe again before finishing",
    source="ISO 230-3",
    separated_by={
        "axis_thermal_growth": ("laser_diagonals", "longer_session", "single_axis_laser"),
        "squareness_thermal": ("second_radius", "longer_session", "laser_diagonals"),
        "spindle_thermal_drift": ("longer_session", "ballbar"),
        "dead_path": ("ballbar",),
    },
)
