"""Lateral play: a carriage jumps sideways when its axis reverses."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F3
from abbe.models.effects.columns import LATERAL_KEYS, UM, VISITED, along, axis_of, direction_of, first, of_machine, of_path, share_of_stroke
from abbe.models.effects.effect import Effect, Form, Values
from abbe.models.effects.path import Path, Places

SETTLING_MM = (0.1, 0.5, 3.0)


def jump(at: Places, key: str, values: Values) -> F3:
    """Return a sideways shift of P/2 times the direction in which the axis last moved, P = 1 um."""
    return along(direction_of(key), 0.5 * UM * at.sign[:, axis_of(key)])


def _settling(at: Places, key: str, values: Values) -> F3:
    """Return a jump that is spread over some travel of the axis, one column per length in `SETTLING_MM`."""
    a = axis_of(key)
    return along(direction_of(key), *(0.5 * UM * at.sign[:, a] * np.exp(-at.since_mm[:, a] / d) for d in SETTLING_MM))


def _along_guide(path: Path, at: Places, key: str, values: Values) -> F3:
    """Return a jump that changes along the guide, because the guide is worn at one end or in the middle."""
    a = axis_of(key)
    x = share_of_stroke(at.q_mm[:, a], path.machine.stroke_mm[a])
    half = 0.5 * UM * at.sign[:, a]
    return along(direction_of(key), half * x, half * (x**2 - VISITED))


def _at_rest(path: Path, at: Places, key: str, values: Values) -> F3:
    """Return the shift in runs that do not move the axis. Its last motion is unknown, and counts as the same before all these runs."""
    rests = at is path.at and not at.sign[:, axis_of(key)].any()
    return along(direction_of(key), np.full(len(at.t_s), 0.5 * UM * rests))


EFFECT = Effect(
    name="lateral_play",
    title="lateral play of a carriage",
    family="structure",
    keys=LATERAL_KEYS,
    unit="um",
    per_unit=1.0,
    typical=(1.0, 8.0),
    shape=(),
    signal=of_machine(jump),
    strength=first,
    forms=(Form("settling", of_machine(_settling)), Form("along the guide", of_path(_along_guide)), Form("at rest", of_path(_at_rest))),
    needs="runs in both directions",
    signature="a step across the axis where it reverses: a pair of steps or spikes away from the ends of the deviating axis",
    remedy="mechanics",
    remedy_text="adjust gib or preload of the carriage's guide",
    source="usual model: a step with the direction of motion",
    separated_by={
        "lateral_play": ("ballbar", "planar_circles"),
        "backlash": ("planar_circles", "ballbar"),
        "servo_mismatch": ("second_feed", "laser_diagonals"),
        "straightness": ("opposite_direction",),
    },
)
