"""Did the tool go where a new table sends it? Sign, axis and unit of a real table, from a ball-bar that read the same places before.

The bar stays hung in while the table changes: at each place the reading changes by u . (new correction - old correction), u being the
direction from cup to spindle. Nothing that can be read back from a control shows this (reliability.md 3.2, PROBE). A place at which it
changes by something else refutes the table, whether or not the change is large enough to prove it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.compensation.sign_proof import FLOOR_MM, SHARE
from abbe.models.compensation.tables import NineTables
from abbe.models.machine import AXES

SHOWN = 3
SEEN_MM = 0.003
"""Less than this at the strongest place: a table with the sign turned over could not be distinguished from drift within what is allowed."""


@dataclass(frozen=True)
class Probe:
    """What a bar has seen of a table.

    Parameters
    ----------
    expected_mm, measured_mm : array, shape (n,)
        Change of the reading at every place, positive: longer.
    seen : tuple of bool
        For X, Y, Z: what the table does to this axis is large enough at some place that a wrong sign of it would have been noticed.
    agrees : bool
        At every place the reading changed as expected, within the larger of 2 um and 20 % of the largest expected change.
    """

    expected_mm: F1
    measured_mm: F1
    seen: tuple[bool, bool, bool]
    agrees: bool

    @property
    def text(self) -> str:
        """What was expected and measured where it differs most, or else where most was expected, µm."""
        off = np.abs(self.measured_mm - self.expected_mm)
        order = np.argsort(-np.nan_to_num(np.abs(self.expected_mm) if self.agrees else off, nan=np.inf), kind="stable")[:SHOWN]
        pairs = ", ".join(f"{1e3 * self.measured_mm[k]:+.1f} ({1e3 * self.expected_mm[k]:+.1f} expected)" for k in order)
        axes = [axis for axis, seen in zip(AXES, self.seen, strict=True) if not seen]
        blind = f"; too small to prove the sign of {', '.join(axes)}" if axes else ""
        return f"the ball-bar's reading changed by {pairs} um{blind}"


def expected_changes(places_mm: F2, centre_mm: F1, old: NineTables | None, new: NineTables) -> F2:
    """What each axis' new corrections do to the bar's reading at commanded places, shape (n, 3), mm; their sum is the change.

    Parameters
    ----------
    places_mm : array, shape (n, 3)
        Commanded positions.
    centre_mm : array, shape (3,)
        Of the sphere: where the cup was mounted. It stays where it is when the table changes.
    old, new : NineTables
        In force before (None: no correction) and after.
    """
    out = places_mm - centre_mm
    change = new.correction_at(places_mm) - (0.0 if old is None else old.correction_at(places_mm))
    return np.asarray(out / np.linalg.norm(out, axis=1)[:, None] * change, dtype=np.float64)


def probe(each_mm: F2, before_mm: F1, after_mm: F1) -> Probe:
    """Compare what the bar read before and after with what the tables say.

    Parameters
    ----------
    each_mm : array, shape (n, 3)
        From `expected_changes`.
    before_mm, after_mm : array, shape (n,)
        Readings at the same places.

    Raises
    ------
    ValueError
        The arrays do not belong together.
    """
    if not len(each_mm) == len(before_mm) == len(after_mm) > 0:
        raise ValueError("sign probe: expected changes and readings are not of the same places")
    measured, expected = after_mm - before_mm, each_mm.sum(axis=1)
    allowed = max(FLOOR_MM, SHARE * float(np.abs(expected).max()))
    # Turned over, an axis would change the reading by twice its share: that has to be beyond what is allowed.
    largest = np.abs(each_mm).max(axis=0)
    x, y, z = ((largest >= SEEN_MM) & (2.0 * largest > 1.5 * allowed)).tolist()
    return Probe(expected, measured, (x, y, z), bool((np.abs(measured - expected) <= allowed).all()))
