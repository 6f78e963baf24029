"""Runs as they were meant: what is only the rounding of commanded positions and beams must not count as information.

A rank counts whatever is above 1e-9, and positions are written down to 1 um or less. On a straight path, along an axis or in a plane, the
rounding looks like a small motion of the other axes: a laser line along X whose beam is written 1e-9 off would "show" the straightness of
X in both directions.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from models.arrays import F2
from models.solvers.observations import RunData
from models.solvers.observe_setup import NEAR_BEAM, STRAIGHT_MM, straight_line_of


def as_meant(run: RunData) -> RunData:
    """The run with straight paths exactly straight and along their beam, and axes that hardly move exactly at rest.

    Nothing moves by more than `STRAIGHT_MM`, no beam by more than `NEAR_BEAM`. Step diagonals and helices stay as they are.
    """
    if run.kind == "bar":
        return replace(run, axes_mm=_resting(run.axes_mm))
    line = straight_line_of(run.axes_mm)
    if line is None or run.beam is None or not line[1].any():
        return replace(run, axes_mm=_resting(run.axes_mm))
    middle, along = line
    straight = middle + np.outer((run.axes_mm - middle) @ along, along)
    near = float(np.linalg.norm(np.cross(along, run.beam))) <= NEAR_BEAM
    return replace(run, axes_mm=straight, beam=along * np.sign(along @ run.beam) if near else run.beam)


def _resting(axes_mm: F2) -> F2:
    """Positions with every axis that moves by less than `STRAIGHT_MM` at one place."""
    middle = axes_mm.mean(axis=0)
    return np.where(np.abs(axes_mm - middle).max(axis=0) < STRAIGHT_MM, middle, axes_mm)
