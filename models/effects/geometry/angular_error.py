"""Angular error: a carriage turns as it moves, and the lever arm to the tool makes this rotation a deviation of the tool."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F3
from abbe.models.effects.columns import PPM, WITH_CONSTANT, of_body, rms, smooth
from abbe.models.effects.effect import Effect, Form, Signal
from abbe.models.effects.path import Path, Places
from abbe.models.machine import AXES, levers_mm

KEYS = tuple(f"E{turn}{axis}" for axis in AXES for turn in "ABC")


def _columns(path: Path, at: Places, key: str, first: int, last: int) -> F3:
    """Return Legendre orders of the position, 1 urad rms over the stroke each, times the arm of the carriage (rule G)."""
    a, turn = AXES.index(key[2]), np.eye(3)["ABC".index(key[1])]
    arm = np.cross(turn, levers_mm(path.machine, at.q_mm)[:, a])
    return np.asarray(PPM * arm[:, :, None] * smooth(at.q_mm[:, a], path.machine.stroke_mm[a], first, last)[:, None, :])


def _turns(path: Path, at: Places, key: str, first: int, last: int) -> F3:
    a, turn = AXES.index(key[2]), np.eye(3)["ABC".index(key[1])]
    return np.asarray(PPM * turn[:, None] * smooth(at.q_mm[:, a], path.machine.stroke_mm[a], first, last)[:, None, :])


def _orders(first: int, last: int) -> Signal:
    """Make the signal of Legendre orders ``first`` to ``last``, through the lever arm and the turning mirror."""
    return of_body(
        lambda path, at, key, values: _columns(path, at, key, first, last), lambda path, at, key, values: _turns(path, at, key, first, last)
    )


EFFECT = Effect(
    name="angular_error",
    title="angular error of an axis",
    family="geometry",
    keys=KEYS,
    unit="urad",
    per_unit=1.0,
    typical=(5.0, 40.0),
    shape=(),
    signal=_orders(1, 6),
    strength=rms,
    forms=(Form("finer", _orders(7, 9)), Form("finest", _orders(10, 13))),
    unseen=WITH_CONSTANT,
    needs="an arm that varies: other axes at several positions, or a second tool length",
    signature="like straightness or positioning of the axis, but growing with the distance from its guide",
    remedy="table",
    remedy_text="a spatial or angular compensation table; realign the guide if it is large",
    source="Pahk: bands of 11 to 39 urad",
    absorbed_by=("rigid21",),
    separated_by={
        "straightness": ("second_tool_length", "angular_interferometer"),
        "positioning_nonlinear": ("second_tool_length", "angular_interferometer", "second_radius", "laser_diagonals"),
        "angular_error": ("angular_interferometer", "second_tool_length"),
        "ram_sag": ("second_tool_length", "laser_diagonals"),
        "nonrigid_bed": ("second_tool_length", "angular_interferometer"),
    },
)
