"""Backlash that depends on position: the screw is worn where it works most, or winds up more where its free length is longer."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F3
from abbe.models.effects.columns import AXIS_KEYS, UM, VISITED, along, axis_of, first, of_path, play, share_of_stroke, turn_between, wind_up
from abbe.models.effects.effect import Effect, Form, Values
from abbe.models.effects.path import Path, Places

WIND_UP_MM = (0.05, 0.3)


def _half(at: Places, key: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.asarray(-0.5 * UM * play(at, axis_of(key)))


def unequal(path: Path, at: Places, key: str, values: Values) -> F3:
    """Return two columns: mean width, -s/2 times 1 um, and its change over the stroke, -s x/2 times 1 um.

    ``s`` is the direction of motion (+1 or -1), ``x`` the position, -1 to +1 over the stroke.
    """
    a = axis_of(key)
    x = share_of_stroke(at.q_mm[:, a], path.machine.stroke_mm[a])
    return along(a, _half(at, key), _half(at, key) * x)


def _curved(path: Path, at: Places, key: str, values: Values) -> F3:
    """Return columns for a width that changes with x^2 or x^3: wear in the middle or at the ends."""
    a = axis_of(key)
    x = share_of_stroke(at.q_mm[:, a], path.machine.stroke_mm[a])
    return along(a, _half(at, key) * (x**2 - VISITED), _half(at, key) * x**3)


def _wind_up(path: Path, at: Places, key: str, values: Values) -> F3:
    a = axis_of(key)
    return along(a, *(-0.5 * UM * w for w in wind_up(at, a, *WIND_UP_MM)))


def _turning(path: Path, at: Places, key: str, values: Values) -> F3:
    a = axis_of(key)
    x = share_of_stroke(at.q_mm[:, a], path.machine.stroke_mm[a])
    turn = -0.5 * UM * turn_between(at, a)
    return along(a, turn, turn * x)


EFFECT = Effect(
    name="backlash_position_dependent",
    title="backlash that depends on the position",
    family="drive",
    keys=AXIS_KEYS,
    unit="um",
    per_unit=1.0,
    typical=(1.0, 30.0),
    shape=(),
    signal=of_path(unequal),
    strength=first,
    forms=(Form("curved", of_path(_curved)), Form("wind-up", of_path(_wind_up)), Form("turning", of_path(_turning))),
    needs="both directions and at least two places on the axis: two origins, or two radii",
    signature="the steps at the two ends of the axis differ, or differ between two origins",
    remedy="mechanics",
    remedy_text="the screw is worn where it works most: replace or regrind it; a table of backlash over position helps meanwhile",
    source="usual model: B (1 + k x), unequal backlash",
    variant_of="backlash",
    separated_by={
        "backlash": ("second_radius",),
        "servo_mismatch": ("second_feed", "laser_diagonals"),
        "reversal_spike": ("laser_diagonals", "second_feed"),
        "backlash_position_dependent": ("ballbar", "planar_circles", "opposite_direction"),
        "lateral_play": ("ballbar", "planar_circles"),
    },
)
