"""In which order a controller adds its corrections, and at which position it looks each of them up.

A machine's error acts where the axis is driven, at q = p + c, for a command p. Some controls look every table up at the command and add
all; some add the positioning tables first and look straightness and cross tables up at the position so corrected. Both are right to first
order. What separates them is the slope of the later table times the earlier correction: with 20 um/m of slope and 50 um of correction 1 nm,
but the steep tables of a ball screw's cyclic error can make it whole micrometres. `at_corrected_position` makes the tables for the second
kind; `second_order_mm` says how large the difference is for the tables at hand.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from abbe.models.arrays import F2
from abbe.models.compensation.distances import Correction
from abbe.models.compensation.tables import NineTables

Lookup = Literal["command", "corrected"]
ITERATIONS = 6
"""Steps of p = q - c(p): each gains a factor of the slope of c, 1e-3 at the worst."""


@dataclass(frozen=True, slots=True)
class Stage:
    """One step of a controller: a correction, looked up at the ``command`` or at the position ``corrected`` by the stages before it."""

    correction: Correction
    lookup: Lookup = "command"


def applied(stages: tuple[Stage, ...], axes_mm: F2) -> F2:
    """What a controller adds in all to commanded positions, shape (n, 3), mm."""
    total: F2 = np.zeros(axes_mm.shape)
    for stage in stages:
        total = total + stage.correction(axes_mm + total if stage.lookup == "corrected" else axes_mm)
    return total


def at_corrected_position(tables: NineTables) -> NineTables:
    """The cross tables of nine for a controller that looks them up at the position its own-axis tables have corrected.

    At q = p + c(p) stands what the nine tables hold at p, c being the own-axis table. Own-axis tables come back unchanged: use both as
    ``Stage(positioning_only(t).correction_at), Stage(cross_only(t).correction_at, "corrected")``.
    """
    out = []
    for a in range(3):
        grid, nine = tables.position_mm[a], tables.correction_mm[a]
        p = grid
        for _ in range(ITERATIONS):
            p = grid - np.interp(p, grid, nine[:, a])
        columns = [nine[:, i] if i == a else np.interp(p, grid, nine[:, i]) for i in range(3)]
        out.append(np.column_stack(columns))
    return NineTables(tables.position_mm, (out[0], out[1], out[2]), tables.u_mm)


def of_corrected_position(wanted: Correction) -> Correction:
    """Correction as a function of the command that is ``wanted`` as a function of where the axes are driven: c(p) = wanted(p + c(p)).

    Minus the deviation is such a ``wanted``: the error acts where the axes stand, not where they were told to go.
    """

    def at(axes_mm: F2) -> F2:
        found: F2 = np.zeros(axes_mm.shape)
        for _ in range(ITERATIONS):
            found = wanted(axes_mm + found)
        return found

    return at


def second_order_mm(stages: tuple[Stage, ...], axes_mm: F2) -> float:
    """Largest change of any axis' correction over the given positions if every stage were looked up at the command instead, mm."""
    plain = tuple(Stage(s.correction) for s in stages)
    return float(np.abs(applied(stages, axes_mm) - applied(plain, axes_mm)).max())
