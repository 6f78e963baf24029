"""Servo mismatch: one axis lags the others by a constant time, so its error is proportional to its velocity."""

from __future__ import annotations

from abbe.models.arrays import F3
from abbe.models.effects.columns import AXIS_KEYS, along, axis_of, first, of_machine
from abbe.models.effects.effect import Effect, Form, Values
from abbe.models.effects.path import Places

MS = 1e-3
USUAL_MM_S = 25.0
"""Speed (1500 mm/min) at which the strength is stated."""


def late(at: Places, key: str, values: Values) -> F3:
    """Return -1 ms times the velocity of the axis."""
    a = axis_of(key)
    return along(a, -MS * at.v_mm_s[:, a])


def _acceleration(at: Places, key: str, values: Values) -> F3:
    a = axis_of(key)
    return along(a, MS * 1e-2 * at.a_mm_s2[:, a])


def _saturated(at: Places, key: str, values: Values) -> F3:
    """Return the error by a delay that is zero at `USUAL_MM_S` and grows with the speed, by 1 ms per 100 mm/s."""
    a = axis_of(key)
    v = at.v_mm_s[:, a]
    return along(a, -MS * v * (abs(v) - USUAL_MM_S) / 100.0)


EFFECT = Effect(
    name="servo_mismatch",
    title="servo mismatch",
    family="drive",
    keys=AXIS_KEYS,
    unit="ms",
    per_unit=1.0,
    typical=(0.02, 0.6),
    shape=(),
    signal=of_machine(late),
    strength=first,
    forms=(Form("acceleration", of_machine(_acceleration)), Form("with speed", of_machine(_saturated))),
    needs="both directions, two feeds, and three planes or a helix to find the axis",
    signature="an oval at 45 degrees that turns by 90 degrees with the direction and grows with the feed",
    remedy="control parameter",
    remedy_text="match the position gain (Kv) or feed-forward of the axis to the values of the other two",
    source="Kakino et al. 1993",
    blind=("laser_diagonal", "laser_linear"),
    separated_by={
        "servo_mismatch": ("planar_circles", "ballbar"),
        "backlash": ("second_feed", "laser_diagonals"),
        "backlash_position_dependent": ("second_feed", "laser_diagonals"),
        "lateral_play": ("second_feed", "laser_diagonals"),
        "contour_lag": ("second_feed", "opposite_direction"),
    },
)
