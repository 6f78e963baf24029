"""The axis of a ball-bar path and the angle about it: the common rule for reports, comparisons, pages and the live picture."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.machine import AXES
from abbe.service.domain.run import Run
from abbe.service.errors import MeasurementFault

STRAIGHT = 0.8
"""Along its axis a helix advances: least ratio of net to total travel."""
ROUND = 0.5
"""Across its axis a helix goes round: largest ratio of net to total travel. Less than a turn is not a helix."""


def helix_axis(stated: str, at_mm: F2) -> int | None:
    """Axis of a helix, 0 to 2: as the set-up states it, else the axis along which the commanded path advances.

    None if the set-up states no axis, and the path advances along none or along several.

    Parameters
    ----------
    stated : str
        Letter of the axis in the set-up, or empty.
    at_mm : array, shape (n, 3)
        Commanded positions in chronological order, mm.
    """
    if stated:
        return AXES.index(stated)
    if len(at_mm) < 3:
        return None
    way = np.abs(np.diff(at_mm, axis=0)).sum(axis=0)
    forth = np.divide(np.abs(at_mm[-1] - at_mm[0]), way, out=np.ones(3), where=way > 0.0)
    forth[way <= 0.0] = 0.0
    along = int(np.argmax(forth))
    across = np.delete(forth, along)
    return along if forth[along] >= STRAIGHT and (across <= ROUND).all() else None


def about_axis(at_mm: F2, axis: int) -> F1:
    """Angle of points about an axis, rad, shape (n,), from the next axis towards the one after it (about Z: from X to Y)."""
    a, b = (axis + 1) % 3, (axis + 2) % 3
    return np.asarray(np.arctan2(at_mm[:, b], at_mm[:, a]), dtype=np.float64)


def circle_axis(plane: str) -> int:
    """Axis normal to a plane given by two letters, 0 to 2. Raises MeasurementFault for anything else."""
    if len(plane) != 2:
        raise MeasurementFault(f"a circle lies in a plane of two axes, not in {plane!r}", "state the plane in its set-up, for example XY")
    return 3 - sum(AXES.index(letter) for letter in plane)


def path_axis(run: Run, at_mm: F2) -> int:
    """Axis of a ball-bar run: the normal of a circle's plane, or `helix_axis`.

    Raises
    ------
    MeasurementFault
        Neither set-up nor path determines the axis of a helix.
    """
    if run.test == "ballbar_circle":
        return circle_axis(run.bar.plane)
    found = helix_axis(run.bar.axis, at_mm)
    if found is None:
        raise MeasurementFault(
            f"run {run.run_id}: its set-up states no axis of the helix, and its path advances along none",
            'state it in the set-up: "axis": "X", "Y" or "Z"',
        )
    return found
