"""Runs as they were meant: what is only the rounding of commanded positions and beams must not count as information.

A rank counts whatever is above 1e-9, and positions are written down to 1 um or less. On a straight path, along an axis or in a plane, the
rounding looks like a small motion of the other axes: a laser line along X whose beam is written 1e-9 off would "show" the straightness of
X in both directions.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from abbe.models.arrays import F2
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe_setup import NEAR_BEAM, STRAIGHT_MM, straight_line_of

BAR_TRAVEL_MM = 1.0
"""Measuring range of a usual ball-bar to either side: farther from its nominal length no position was meant to be."""


def as_meant(run: RunData) -> RunData:
    """The run with straight paths exactly straight and along their beam, and axes that hardly move exactly at rest.

    No straight path moves by more than `STRAIGHT_MM`, no beam by more than `NEAR_BEAM`; step diagonals stay as they are. A ball-bar runs on
    the sphere of its nominal length: rounded positions, chords and means of blocks lie beside it by `BAR_TRAVEL_MM` at most. Off the
    sphere a common scale of the machine would differ from the length of the bar in the eighth digit, and the rank would call it told.
    """
    if run.kind == "bar":
        return replace(run, axes_mm=_resting(_on_the_sphere(run)))
    line = straight_line_of(run.axes_mm)
    if line is None or run.beam is None or not line[1].any():
        return replace(run, axes_mm=_resting(run.axes_mm))
    middle, along = line
    straight = middle + np.outer((run.axes_mm - middle) @ along, along)
    near = float(np.linalg.norm(np.cross(along, run.beam))) <= NEAR_BEAM
    return replace(run, axes_mm=straight, beam=along * np.sign(along @ run.beam) if near else run.beam)


def _on_the_sphere(run: RunData) -> F2:
    """Positions of a ball-bar run with the nominal distance from the cup, if all of them are within the bar's range of it."""
    assert run.centre_mm is not None
    assert run.radius_mm is not None
    bar = _resting(run.axes_mm) - run.centre_mm
    length = np.linalg.norm(bar, axis=1, keepdims=True)
    if np.abs(length - run.radius_mm).max() > BAR_TRAVEL_MM:
        return run.axes_mm
    return np.asarray(run.centre_mm + bar * (run.radius_mm / length))


def _resting(axes_mm: F2) -> F2:
    """Positions with every axis that moves by less than `STRAIGHT_MM` at one place."""
    middle = axes_mm.mean(axis=0)
    return np.where(np.abs(axes_mm - middle).max(axis=0) < STRAIGHT_MM, middle, axes_mm)
