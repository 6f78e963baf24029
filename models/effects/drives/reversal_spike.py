"""Reversal spike (quadrant glitch): friction reverses, so the axis falls behind and catches up within a fraction of a millimetre."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.effects.columns import AXIS_KEYS, UM, along, axis_of, before_first_turn, first, of_kind
from abbe.models.effects.effect import Effect, Form, Parameter, Values
from abbe.models.effects.path import Path

SHAPE = (
    Parameter("d0_mm", "mm", 0.08, 2.0, 0.4, "usual range: 0.15 to 1 mm", (0.12, 0.3, 0.7, 1.5)),
    Parameter("p", "", 0.0, 1.0, 0.4, "usual range: 0 to 0.8", (0.0, 0.6)),
)


def _height(path: Path, key: str, values: Values) -> F1:
    """Return the signed height, mm, at the commanded feed, of a spike that is 1 um high at 1000 mm/min."""
    return np.asarray(-UM * path.at.sign[:, axis_of(key)] * (path.feed_mm_min / 1000.0) ** values["p"])


def _since(path: Path, key: str) -> F1:
    return np.asarray(path.at.since_mm[:, axis_of(key)])


def _read(path: Path, key: str, *values: F1) -> F2:
    moved = along(axis_of(key), *values)
    return path.read(lambda at: moved if at is path.at else np.zeros((1, 3, len(values))))


RISE = 0.15
"""Length of the rise of a spike as a share of its decay length: the lagging axis stops only after the command reverses."""


def _decay(path: Path, key: str, values: Values) -> F1:
    x = np.minimum(_since(path, key) / values["d0_mm"], 60.0)
    return np.asarray(_height(path, key, values) * np.minimum(x / RISE, 1.0) * np.exp(-x))


def spike(path: Path, key: str, values: Values) -> F2:
    """Return -s h (f / 1000)^p exp(-d / d0) after a short rise: direction s, feed f in mm/min, travel d since the reversal, h = 1 um."""
    return _read(path, key, _decay(path, key, values))


def _unlike(path: Path, key: str, values: Values) -> F2:
    """Return the spike multiplied by the direction of motion (+1, -1): its height then differs between the two ends of the axis."""
    return _read(path, key, _decay(path, key, values) * path.at.sign[:, axis_of(key)])


def _rounded(path: Path, key: str, values: Values) -> F2:
    """Return the spike times d / d0, and times (d / d0)^2, for a slower rise and a longer or shorter tail."""
    x = np.minimum(_since(path, key) / values["d0_mm"], 60.0)
    height = _height(path, key, values) * np.exp(-x)
    return _read(path, key, height * x, height * x**2)


def _at_once(path: Path, key: str, values: Values) -> F2:
    """Return the additional height during the rise of a spike that rises at once."""
    x = np.minimum(_since(path, key) / values["d0_mm"], 60.0)
    return _read(path, key, _height(path, key, values) * np.maximum(1.0 - x / RISE, 0.0))


def _run_in(path: Path, key: str, values: Values) -> F2:
    """Return the tail of a spike that began in the run-in, just before the first reading."""
    past = before_first_turn(path.at, axis_of(key)) / values["d0_mm"]
    return _read(path, key, _height(path, key, values) * np.exp(-np.minimum(past, 60.0)) * (past < 60.0))


EFFECT = Effect(
    name="reversal_spike",
    title="reversal spike (quadrant glitch)",
    family="drive",
    keys=AXIS_KEYS,
    unit="um",
    per_unit=1.0,
    typical=(1.0, 10.0),
    shape=SHAPE,
    signal=of_kind("bar", spike, 1),
    strength=first,
    forms=(
        Form("unlike ends", of_kind("bar", _unlike, 1)),
        Form("rounded", of_kind("bar", _rounded, 2)),
        Form("at once", of_kind("bar", _at_once, 1)),
        Form("run-in", of_kind("bar", _run_in, 1)),
    ),
    needs="at least five readings within twice the decay after a reversal; two feeds for its growth with the feed",
    signature="a short bump outward just after each reversal of the axis and nothing elsewhere",
    remedy="control parameter",
    remedy_text="set the friction (quadrant glitch) compensation of the axis; check its guide and lubrication if it grows",
    source="usual model: exponential decay; a drive maker shows a quadrant step of 4.7 um",
    blind=("laser_diagonal", "laser_linear"),
    separated_by={
        "reversal_spike": ("planar_circles",),
        "backlash": ("laser_diagonals", "second_feed"),
        "backlash_position_dependent": ("laser_diagonals", "second_feed"),
        "stick_slip": ("second_feed",),
        "lateral_play": ("laser_diagonals",),
    },
)
