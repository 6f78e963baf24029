"""Influence of the active compensation table on the readings of a run, without the part that lost motion absorbs.

A table moves the drives away from the command. Where its corrections change while an axis is commanded to rest, the drive moves by a
micrometre or two and reverses although the command does not. Within the lost motion the axis does not follow, or only partly. There a
solver that sees only the commands finds an error of a few micrometres that no smooth error motion explains.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.geometry.chain import travel_sign

LEAD_IN_MM = 1.0
"""Assumed approach to a run, in the direction of its first motion; longer than any lost motion."""


@dataclass(frozen=True)
class AppliedTables:
    """A compensation table that was active while runs were measured.

    Attributes
    ----------
    correction : callable
        Returns the corrections that the table adds (n, 3), mm, at commanded positions (n, 3), mm.
    lost_mm : array, shape (3,), or None
        Lost motion of X, Y, Z. None: unknown; every axis is assumed to follow its drive.
    """

    correction: Callable[[F2], F2]
    lost_mm: F1 | None = None

    def bar_mm(self, axes_mm: F2, centre_mm: F1) -> F1:
        """Contribution to ball-bar readings at successive commands about a cup set with the spindle, shape (n,), mm.

        The side from which the axes approached the cup is part of the cup offset and not included here.
        """
        away = axes_mm - centre_mm
        look = away / np.linalg.norm(away, axis=1, keepdims=True)
        return np.asarray(np.sum(look * (self.moved_mm(axes_mm) - self.correction(centre_mm[None])), axis=1))

    def laser_mm(self, axes_mm: F2, beam: F1) -> F1:
        """Contribution to the readings of a laser at successive commands, zeroed at the first, shape (n,), mm."""
        moved = self.moved_mm(axes_mm)
        return np.asarray((moved - moved[0]) @ beam)

    def moved_mm(self, axes_mm: F2) -> F2:
        """Displacement of the axes by the table at successive commands, shape (n, 3), mm.

        This is the correction minus the part that lost motion absorbs. The reference is the same machine without a table, where each axis
        ends on the side of its lost motion from which it came.
        """
        added = self.correction(axes_mm)
        if self.lost_mm is None:
            return added
        sign = travel_sign(axes_mm)
        lead = axes_mm[:1] - LEAD_IN_MM * sign[:1]
        before, driven = (lead + self.correction(lead))[0], axes_mm + added
        moved = added.copy()
        for a in np.flatnonzero(self.lost_mm > 0.0):
            half = 0.5 * float(self.lost_mm[a])
            # The approach of an axis that is never commanded to move is unknown.
            start = float(before[a]) if sign[0, a] else float(driven[0, a])
            moved[:, a] -= half * (_play(driven[:, a], start, half) - sign[:, a])
        return moved


def _play(drive_mm: F1, before_mm: float, half_mm: float) -> F1:
    """Play operator: (drive - axis) / half, -1 to 1, after a long move from ``before_mm`` to the first position."""
    axis = float(drive_mm[0]) - half_mm * float(np.sign(drive_mm[0] - before_mm))
    out = []
    for drive in drive_mm.tolist():
        axis = min(max(axis, drive - half_mm), drive + half_mm)
        out.append((drive - axis) / half_mm)
    return np.array(out)
