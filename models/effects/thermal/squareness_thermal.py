"""Squareness that drifts: columns or beams warm up on one side and lean."""

from __future__ import annotations

from abbe.models.arrays import F1, F3
from abbe.models.effects.columns import CAMPAIGN_S, PPM, VISITED, WITH_SLOW, along, first, of_strokes, share_of_stroke, warmth
from abbe.models.effects.effect import Effect, Form, Parameter, Values
from abbe.models.effects.path import Path, Places

CARRIED = {"XY": (1, 0, -1.0), "ZX": (2, 0, 1.0), "YZ": (2, 1, -1.0)}
"""By squareness: axis that travels, direction that deviates, sign of the right-handed rotation (docs/explanation/conventions.md)."""


def _travel(path: Path, at: Places, key: str) -> tuple[int, F1]:
    axis, direction, sign = CARRIED[key]
    return direction, sign * PPM * (at.q_mm[:, axis] - float(path.machine.stroke_mm[axis, 0]))


def leaning(path: Path, at: Places, key: str, values: Values) -> F3:
    """Return the deviation by a squareness C0Y, B0Z or A0Z of 1 urad, times 1 - exp(-t / tau)."""
    direction, travel = _travel(path, at, key)
    return along(direction, travel * warmth(at.t_s, values["tau_s"]))


def _second_time(path: Path, at: Places, key: str, values: Values) -> F3:
    direction, travel = _travel(path, at, key)
    now = warmth(at.t_s, values["tau_s"])
    return along(direction, *(travel * (warmth(at.t_s, values["tau_s"] * k) - now) for k in (1.0 / 3.0, 3.0)))


def _bent(path: Path, at: Places, key: str, values: Values) -> F3:
    """Return the deviation by a column that bends as it leans."""
    axis, direction, sign = CARRIED[key]
    low, high = (float(v) for v in path.machine.stroke_mm[axis])
    bow = share_of_stroke(at.q_mm[:, axis], path.machine.stroke_mm[axis]) ** 2 - VISITED
    return along(direction, sign * PPM * 0.5 * (high - low) * bow * warmth(at.t_s, values["tau_s"]))


EFFECT = Effect(
    name="squareness_thermal",
    title="squareness that drifts as the machine warms up",
    family="thermal",
    keys=tuple(CARRIED),
    unit="urad",
    per_unit=1.0,
    typical=(5.0, 60.0),
    shape=(Parameter("tau_s", "s", *CAMPAIGN_S, 3600.0, "as for the growth of axes", (900.0, 2500.0, 7000.0)),),
    signal=of_strokes(leaning),
    strength=first,
    unseen=WITH_SLOW,
    forms=(Form("second time constant", of_strokes(_second_time)), Form("bent", of_strokes(_bent))),
    needs="an early run repeated late; laser diagonals, to separate it from the growth of one axis",
    signature="an oval at 45 degrees that drifts from run to run",
    remedy="warm up or sensor",
    remedy_text="warm up before work, keep sun and draught off the column; a sensor-driven squareness correction if the control has one",
    source="Procedia CIRP 58 (2017) 457: tilt of about 50 urad",
    separated_by={
        "axis_thermal_growth": ("laser_diagonals", "longer_session"),
        "spindle_thermal_drift": ("second_radius", "longer_session", "laser_diagonals"),
        "squareness_thermal": ("planar_circles", "laser_diagonals"),
        "air_refraction": ("ballbar",),
    },
)
