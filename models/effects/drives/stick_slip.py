"""Stick-slip: at creeping speed an axis sticks and jumps, so its readings get rough near its reversals."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F2
from abbe.models.effects.columns import AXIS_KEYS, UM, axis_of, of_kind, size
from abbe.models.effects.effect import Effect, Parameter, Values
from abbe.models.effects.path import Path


def rough(path: Path, key: str, values: Values) -> F2:
    """Return the extra variance of the bar's reading by a saw-tooth of 1 um (1 um^2 / 3) that fades above the axis speed v_c."""
    a = axis_of(key)
    if np.ptp(path.at.q_mm[:, a]) == 0.0:
        return np.zeros((path.n, 1))
    creeps = np.exp(-2.0 * (path.at.v_mm_s[:, a] / values["v_c"]) ** 2)
    return np.asarray(UM**2 / 3.0 * path.look[:, a] ** 2 * creeps)[:, None]


EFFECT = Effect(
    name="stick_slip",
    title="stick-slip of an axis",
    family="drive",
    keys=AXIS_KEYS,
    unit="um",
    per_unit=1.0,
    typical=(1.0, 6.0),
    shape=(Parameter("v_c", "mm/s", 0.5, 5.0, 2.0, "usual range: 1 to 4 mm/s", (0.8, 1.3, 2.0, 3.2, 4.5)),),
    signal=of_kind("bar", rough, 1),
    strength=size,
    needs="a ball-bar run at a low feed",
    signature="bursts of roughness where the axis creeps, around its reversals, worse at low feed",
    remedy="mechanics",
    remedy_text="check lubrication and guide of the axis; friction compensation helps at creeping speed",
    source="usual model: a saw-tooth at creeping speed",
    kind="variance",
    blind=("laser_diagonal", "laser_linear"),
    separated_by={"vibration": ("second_feed",), "reversal_spike": ("second_feed",), "stick_slip": ("planar_circles",)},
)
