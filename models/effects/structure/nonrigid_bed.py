"""Non-rigid bed: the straightness of one axis changes its sign along another."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F3
from abbe.models.effects.columns import LATERAL_KEYS, UM, along, axis_of, direction_of, first, of_strokes, share_of_stroke, third_axis
from abbe.models.effects.effect import Effect, Form, Values
from abbe.models.effects.path import Path, Places


def _shares(path: Path, at: Places, key: str) -> tuple[F1, F1]:
    """Return the position along the moving axis as 0 .. 1, and on the axis that the key does not name as -1 .. +1."""
    stroke = path.machine.stroke_mm
    x = 0.5 * (1.0 + share_of_stroke(at.q_mm[:, axis_of(key)], stroke[axis_of(key)]))
    other = third_axis(key)
    return x, share_of_stroke(at.q_mm[:, other], stroke[other])


def twisted(path: Path, at: Places, key: str, values: Values) -> F3:
    """Return 1 um times sin(pi x / L) (2 y / L_y - 1): x on the moving axis, y on the axis that the key does not name."""
    x, y = _shares(path, at, key)
    return along(direction_of(key), UM * np.sin(np.pi * x) * y)


def _double_bow(path: Path, at: Places, key: str, values: Values) -> F3:
    x, y = _shares(path, at, key)
    return along(direction_of(key), UM * np.sin(2.0 * np.pi * x) * y)


def _curved_across(path: Path, at: Places, key: str, values: Values) -> F3:
    x, y = _shares(path, at, key)
    return along(direction_of(key), UM * np.sin(np.pi * x) * (y**2 - 1.0 / 3.0), UM * np.sin(np.pi * x) * (y**3 - 0.6 * y))


EFFECT = Effect(
    name="nonrigid_bed",
    title="bed that is not rigid",
    family="structure",
    keys=LATERAL_KEYS,
    unit="um",
    per_unit=1.0,
    typical=(2.0, 20.0),
    shape=(),
    signal=of_strokes(twisted),
    strength=first,
    forms=(Form("double bow", of_strokes(_double_bow)), Form("curved across", of_strokes(_curved_across))),
    needs="at least two origins on the other axis and laser diagonals; a model with 21 error motions absorbs most of it",
    signature="the straightness of an axis changes its sign from one side of the table to the other",
    remedy="mechanics",
    remedy_text="level the machine, check feet and foundation, put heavy loads in the middle; a spatial table can take the rest out",
    source="usual model: sin(pi x / L) (2 y / L_y - 1)",
    separated_by={
        "nonrigid_bed": ("laser_diagonals", "second_radius"),
        "ram_sag": ("laser_diagonals", "ballbar"),
        "straightness": ("laser_diagonals", "second_radius"),
        "angular_error": ("second_tool_length", "angular_interferometer"),
        "air_refraction": ("ballbar", "longer_session"),
    },
)
