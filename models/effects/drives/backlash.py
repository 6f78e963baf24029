"""Backlash (lost motion): after a reversal the axis lags its command by half the play."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from abbe.models.arrays import F3
from abbe.models.effects.columns import (
    AXIS_KEYS,
    CAMPAIGN_S,
    UM,
    along,
    axis_of,
    before_first_turn,
    first,
    of_machine,
    play,
    turn_between,
    wind_up,
)
from abbe.models.effects.effect import Effect, Form, Parameter, Values
from abbe.models.effects.path import Places

WIND_UP_MM = (0.05, 0.15, 0.5, 2.0)
"""Lengths over which screw, coupling and guide wind up before the carriage follows, mm; much shorter lengths look like a step."""


def lost_motion(at: Places, key: str, values: Values) -> F3:
    """Return -B/2 times the direction of the last motion, B = 1 um; the change takes place while the axis crosses its play."""
    a = axis_of(key)
    return along(a, -0.5 * UM * play(at, a))


def _wind_up(at: Places, key: str, values: Values) -> F3:
    a = axis_of(key)
    return along(a, *(-0.5 * UM * w for w in wind_up(at, a, *WIND_UP_MM[:3])))


def _slow_wind_up(at: Places, key: str, values: Values) -> F3:
    a = axis_of(key)
    return along(a, -0.5 * UM * wind_up(at, a, WIND_UP_MM[3])[0])


def _turning(at: Places, key: str, values: Values) -> F3:
    return along(axis_of(key), -0.5 * UM * turn_between(at, axis_of(key)))


def _run_in(at: Places, key: str, values: Values) -> F3:
    """Return the wind-up left from a reversal just before the first reading."""
    a = axis_of(key)
    return along(a, -0.5 * UM * at.sign[:, a] * np.exp(-before_first_turn(at, a) / WIND_UP_MM[2]))


def _begun(at: Places, key: str, values: Values) -> F3:
    return lost_motion(at, key, values) * (at.t_s >= values["t0_s"])[:, None, None]


EFFECT = Effect(
    name="backlash",
    title="backlash (lost motion)",
    family="drive",
    keys=AXIS_KEYS,
    unit="um",
    per_unit=1.0,
    typical=(2.0, 30.0),
    shape=(),
    signal=of_machine(lost_motion),
    strength=first,
    forms=(
        Form("wind-up", of_machine(_wind_up)),
        Form("slow wind-up", of_machine(_slow_wind_up)),
        Form("turning", of_machine(_turning)),
        Form("run-in", of_machine(_run_in)),
    ),
    needs="runs in both directions; a laser alone hardly separates X, Y and Z",
    signature="circle and helix: a step outward at both ends of the axis, equal at all feeds; laser: forth and back stay apart",
    remedy="control parameter",
    remedy_text="enter the width as backlash compensation of the axis; "
    "if it grows or exceeds 30 um: check screw nut, coupling, thrust bearing",
    source="ISO 230-2 (reversal value), ISO 230-4; usual model: a step with the direction of motion",
    separated_by={
        "backlash": ("ballbar", "planar_circles", "opposite_direction"),
        "backlash_position_dependent": ("second_radius",),
        "dead_path": ("opposite_direction", "ballbar"),
        "servo_mismatch": ("second_feed", "laser_diagonals"),
        "reversal_spike": ("laser_diagonals", "second_feed"),
        "lateral_play": ("ballbar", "planar_circles"),
        "straightness": ("opposite_direction",),
    },
)
BEGUN = replace(
    EFFECT,
    name="backlash_begun",
    title="backlash (lost motion) that begins during the campaign",
    shape=(Parameter("t0_s", "s", 0.0, 10.0 * CAMPAIGN_S[1], CAMPAIGN_S[0], "clock of the campaign", CAMPAIGN_S),),
    signal=of_machine(_begun),
    forms=(),
    needs="the same reversals before and after it begins",
    signature="the steps of a lost motion are missing in the first runs",
    remedy="mechanics",
    remedy_text="find what came loose: coupling, nut, thrust bearing or clamp; enter no backlash compensation before that",
    variant_of="backlash",
    beside=("backlash", "backlash_position_dependent", "servo_mismatch", "reversal_spike"),
)
"""Lost motion that begins during the campaign. A lost motion that grows by a step is found as `EFFECT` and `BEGUN` together."""
