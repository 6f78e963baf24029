"""Tilt of the laser's flat mirror: steps across the beam become readings along it."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.effects.columns import NO_KEY, PPM, per_setup, setup_length
from abbe.models.effects.effect import Effect, Values
from abbe.models.effects.path import Path


def across(beam: F1) -> F2:
    """Return two unit vectors across the beam n, shape (2, 3): e1 along n × a, a the axis of the smallest component of n; e2 = n × e1."""
    one = np.cross(beam, np.eye(3)[int(np.argmin(np.abs(beam)))])
    one /= np.linalg.norm(one)
    return np.stack([one, np.cross(beam, one)])


def tilted(path: Path, values: Values) -> F2:
    """Return 1 urad times the displacement across the beam since the first record, in two directions: two coefficients per laser set-up."""
    return np.asarray(PPM * (path.at.q_mm - path.reference.q_mm) @ across(path.look[0]).T)


EFFECT = Effect(
    name="mirror_tilt",
    title="tilt of the laser's mirror",
    family="instrument",
    keys=NO_KEY,
    unit="urad",
    per_unit=1.0,
    typical=(10.0, 500.0),
    shape=(),
    signal=per_setup("laser", 2, tilted),
    strength=setup_length(2),
    needs="step diagonals",
    signature="a saw-tooth with a period of three steps that returns to zero at every point of the diagonal",
    remedy="set-up",
    remedy_text="not an error of the machine: square the mirror to the beam, or let its tilt be fitted as an unknown of the set-up",
    source="Wang: 0.5 mrad times 50 mm makes 25 um",
    absorbed_by=("mirror_tilt",),
    blind=("ballbar_helix", "ballbar_circle"),
    separated_by={"laser_cosine": ("laser_diagonals",), "straightness": ("ballbar",)},
)
