"""Vibration: an axis oscillates at its own frequency while it moves."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F2
from abbe.models.effects.columns import AXIS_KEYS, UM, axis_of, of_kind, order_of, size
from abbe.models.effects.effect import Effect, Values
from abbe.models.effects.path import Path


def swinging(path: Path, key: str, values: Values) -> F2:
    """Return the extra variance of the bar's reading by a sine of 1 um (1 um^2 / 2) of unknown phase."""
    return np.asarray(UM**2 / 2.0 * path.look[:, axis_of(key)] ** 2)[:, None]


def line(paths: tuple[Path, ...], key: str, f_hz: float) -> list[F2]:
    """Return sine and cosine columns of one frequency along the axis, amplitude 1 um, shape (n, 2 runs) for each path.

    Every ball-bar run has a pair of columns of its own, in the order of the labels, because its phase is unknown. A search over
    frequencies uses these columns as the mean signal of a steady vibration.
    """
    a, place = axis_of(key), order_of(path.label for path in paths if path.kind == "bar")
    out = []
    for path in paths:
        columns = np.zeros((path.n, 2 * max(len(place), 1)))
        if path.kind == "bar":
            phase, k = 2.0 * np.pi * f_hz * path.at.t_s, 2 * place[path.label]
            columns[:, k : k + 2] = UM * path.look[:, a : a + 1] * np.column_stack([np.sin(phase), np.cos(phase)])
        out.append(columns)
    return out


EFFECT = Effect(
    name="vibration",
    title="vibration of an axis",
    family="drive",
    keys=AXIS_KEYS,
    unit="um",
    per_unit=1.0,
    typical=(0.3, 3.0),
    shape=(),
    signal=of_kind("bar", swinging, 1),
    strength=size,
    needs="time stamps, and two rates of sampling to resolve the frequency",
    signature="a line in the spectrum of the readings over time, folded by the sampling, strongest along the axis",
    remedy="control parameter",
    remedy_text="lower the gain or set a notch filter at the frequency; look for a loose motor mount, an unbalanced spindle, a pump nearby",
    source="usual model: a sine of unknown phase",
    kind="variance",
    blind=("laser_diagonal", "laser_linear"),
    separated_by={"stick_slip": ("second_feed",), "vibration": ("planar_circles", "ballbar")},
)
