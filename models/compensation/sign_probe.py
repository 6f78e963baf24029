"""Sign probe of a table: its sign, axis and unit, from a ball-bar's readings of the same places before and after its activation.

The bar stays mounted while the table changes: at each place the reading changes by u . (new correction - old correction), u being the
direction from cup to spindle. Read-back from a control cannot show this (reliability.md 3.2, PROBE). A place at which the reading changes
differently refutes the table, whether or not the change is large enough to prove it.
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
"""Least change at the strongest place; with less, drift within the tolerance could hide a reversed sign."""


@dataclass(frozen=True)
class Probe:
    """Result of a sign probe.

    Parameters
    ----------
    expected_mm, measured_mm : array, shape (n,)
        Change of the reading at every place, positive: longer.
    seen : tuple of bool
        For X, Y, Z: the table's effect on this axis is large enough at some place to show a wrong sign.
    agrees : bool
        At every place the reading changed as expected, within the larger of 2 um and 20 % of the largest expected change.
    """

    expected_mm: F1
    measured_mm: F1
    seen: tuple[bool, bool, bool]
    agrees: bool

    @property
    def text(self) -> str:
        """Measured and expected changes at the places with the largest difference or, if all agree, the largest expected change, µm."""
        off = np.abs(self.measured_mm - self.expected_mm)
        order = np.argsort(-np.nan_to_num(np.abs(self.expected_mm) if self.agrees else off, nan=np.inf), kind="stable")[:SHOWN]
        pairs = ", ".join(f"{1e3 * self.measured_mm[k]:+.1f} ({1e3 * self.expected_mm[k]:+.1f} expected)" for k in order)
        axes = [axis for axis, seen in zip(AXES, self.seen, strict=True) if not seen]
        blind = f"; too small to prove the sign of {', '.join(axes)}" if axes else ""
        return f"the ball-bar's reading changed by {pairs} um{blind}"


def expected_changes(places_mm: F2, centre_mm: F1, old: NineTables | None, new: NineTables) -> F2:
    """Expected change of the bar's reading by each axis' new corrections at commanded places, shape (n, 3), mm.

    Parameters
    ----------
    places_mm : array, shape (n, 3)
        Commanded positions.
    centre_mm : array, shape (3,)
        Of the sphere: where the cup was mounted. It stays where it is when the table changes.
    old, new : NineTables
        Tables active before (None: no correction) and after.
    """
    out = places_mm - centre_mm
    change = new.correction_at(places_mm) - (0.0 if old is None else old.correction_at(places_mm))
    return np.asarray(out / np.linalg.norm(out, axis=1)[:, None] * change, dtype=np.float64)


def probe(each_mm: F2, before_mm: F1, after_mm: F1) -> Probe:
    """Compare the change of the bar's readings with that expected from the tables.

    Parameters
    ----------
    each_mm : array, shape (n, 3)
        From `expected_changes`.
    before_mm, after_mm : array, shape (n,)
        Readings at the same places.

    Raises
    ------
    ValueError
        The arrays differ in length.
    """
    if not len(each_mm) == len(before_mm) == len(after_mm) > 0:
        raise ValueError("sign probe: expected changes and readings are not of the same places")
    measured, expected = after_mm - before_mm, each_mm.sum(axis=1)
    allowed = max(FLOOR_MM, SHARE * float(np.abs(expected).max()))
    # A reversed sign changes the reading by twice the axis' share, which must exceed the tolerance.
    largest = np.abs(each_mm).max(axis=0)
    x, y, z = ((largest >= SEEN_MM) & (2.0 * largest > 1.5 * allowed)).tolist()
    return Probe(expected, measured, (x, y, z), bool((np.abs(measured - expected) <= allowed).all()))
