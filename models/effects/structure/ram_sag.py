"""Sag of a horizontal ram: its end sinks and tilts down more with a longer reach."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from abbe.models.arrays import F1, F3
from abbe.models.effects.columns import NO_KEY, UM, first, of_body, share_of_stroke
from abbe.models.effects.effect import Effect, Form, Parameter, Signal, Values
from abbe.models.effects.path import Path, Places
from abbe.models.machine import levers_mm, split_chain

SHAPE = (
    Parameter("beta", "1", 0.3, 1.0, 0.7, "growth from mid height to the top; above 1 the ram would bend up at the bottom", (0.5, 0.8)),
)


def ram_axis(path: Path) -> int | None:
    """Return the horizontal axis that carries the tool; None if the last carriage is vertical or the tool side has no carriage."""
    tool_side = split_chain(path.machine.chain)[1]
    return tool_side[-1] if tool_side and tool_side[-1] != path.vertical else None


def _sagging(path: Path, *shapes: tuple[F1, F1]) -> tuple[F3, F3]:
    """Return displacement (downwards) and rotation (about the third axis) for sags, um, and their slopes, um per mm of reach."""
    moved = np.zeros((len(shapes[0][0]), 3, len(shapes)))
    turned = np.zeros_like(moved)
    ram = ram_axis(path)
    if ram is None:
        return moved, turned
    down = -np.eye(3)[path.vertical]
    turn = np.cross(np.eye(3)[ram], down)  # turn x (unit vector of the ram) = down
    for k, (sag, slope) in enumerate(shapes):
        moved[:, :, k], turned[:, :, k] = UM * np.outer(sag, down), UM * np.outer(slope, turn)
    return moved, turned


def _tool(path: Path, at: Places, parts: tuple[F3, F3]) -> F3:
    """Return the deviation of the tool: displacement plus rotation times the arm of the ram's carriage."""
    moved, turned = parts
    ram = ram_axis(path)
    return moved if ram is None else np.asarray(moved + np.cross(turned, levers_mm(path.machine, at.q_mm)[:, ram][:, :, None], axis=1))


def _reach(path: Path, at: Places) -> tuple[F1, float, F1]:
    """Return the reach as 0 .. 1 of the ram's stroke, the length of this stroke in mm, and the height of the head as -1 .. +1."""
    ram, stroke = ram_axis(path), path.machine.stroke_mm
    ram = 0 if ram is None else ram
    low, high = (float(v) for v in stroke[ram])
    return (at.q_mm[:, ram] - low) / (high - low), high - low, share_of_stroke(at.q_mm[:, path.vertical], stroke[path.vertical])


def sag(path: Path, at: Places, key: str, values: Values) -> tuple[F3, F3]:
    """Return a downward sag of (z / L)^2 (1 + beta y), 1 um at full reach z = L and mid height y = 0, and the rotation by its slope."""
    z, length, y = _reach(path, at)
    more = 1.0 + values["beta"] * y
    return _sagging(path, (z**2 * more, 2.0 * z / length * more))


def _bent(path: Path, at: Places, key: str, values: Values) -> tuple[F3, F3]:
    """Return two more sags: one with another bending curve, one with another growth with the height."""
    z, length, y = _reach(path, at)
    return _sagging(path, (z**3 * y, 3.0 * z**2 / length * y), (z**2 * y**2, 2.0 * z / length * y**2))


def _read(parts: Callable[[Path, Places, str, Values], tuple[F3, F3]]) -> Signal:
    return of_body(
        lambda path, at, key, values: _tool(path, at, parts(path, at, key, values)),
        lambda path, at, key, values: parts(path, at, key, values)[1],
    )


EFFECT = Effect(
    name="ram_sag",
    title="sag of a horizontal ram",
    family="structure",
    keys=NO_KEY,
    unit="um",
    per_unit=1.0,
    typical=(5.0, 60.0),
    shape=SHAPE,
    signal=_read(sag),
    strength=first,
    forms=(Form("bent", _read(_bent)),),
    needs="a machine with a horizontal ram, two heights of the head, and laser diagonals",
    signature="a parabola over the ram's reach, growing with the height of the head",
    remedy="mechanics",
    remedy_text="check the ram's guide, clamping and counterweight; a spatial table (reach by height) can take the rest out",
    source="usual model: -A (z / L)^2 (1 + beta y)",
    separated_by={
        "nonrigid_bed": ("laser_diagonals", "ballbar", "second_tool_length"),
        "straightness": ("laser_diagonals", "second_radius", "ballbar"),
        "angular_error": ("second_tool_length", "laser_diagonals"),
    },
)
