"""Outliers: a few readings are wrong because a beam was broken, or a ball-bar was bumped, for a moment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from abbe.models.arrays import F2
from abbe.models.effects.columns import NO_KEY, UM, of_kind, size
from abbe.models.effects.effect import Effect, Values
from abbe.models.effects.path import Path


def struck(path: Path, key: str, values: Values) -> F2:
    """Return the extra variance of every laser reading, 1 um^2, which does not depend on the share of outliers."""
    return np.full((path.n, 1), UM**2)


EFFECT = Effect(
    name="beam_outliers",
    title="outliers of the laser beam",
    family="instrument",
    keys=NO_KEY,
    unit="um",
    per_unit=1.0,
    typical=(0.5, 60.0),
    shape=(),
    signal=of_kind("laser", struck, 1),
    strength=size,
    needs="laser runs; a robust fit shows them",
    signature="isolated readings far from their neighbours, 1 to 4 in 100, in no order",
    remedy="set-up",
    remedy_text="clean the optics, keep chips and coolant mist off the beam, repeat the run",
    source="usual model: rare readings with a large variance",
    kind="variance",
    blind=("ballbar_helix", "ballbar_circle"),
    separated_by={"backlash": ("longer_session",)},
)
BAR = replace(
    EFFECT,
    name="bar_outliers",
    title="outliers of the ball-bar",
    signal=of_kind("bar", struck, 1),
    needs="ball-bar runs; a robust fit shows them",
    signature="isolated readings far from their neighbours, in no order",
    remedy_text="clean balls and cups, check magnets, cable and radio link of the bar, repeat the run",
    blind=("laser_diagonal", "laser_linear"),
    separated_by={},
)
"""Outliers of a ball-bar: dirt in a cup, a bumped table, a broken link."""
