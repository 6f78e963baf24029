"""`pahk_diagonals.json`: length deviations of the four space diagonals of the ten types (math.md 2.2, 8)."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F2
from abbe.models.notation.pahk import pahk_type
from abbe.models.papers.pahk.diagonals import space_diagonals
from abbe.models.papers.pahk.tables import ParameterTables, Triple
from abbe.service.vectors.case import VectorCase
from abbe.service.vectors.checks import Checks
from abbe.service.vectors.pahk_parameters import pair, squareness

SUBTRACTED = "two lengths of 1142 mm were subtracted"


def read(case: VectorCase, checks: Checks) -> None:
    """Compare both forms of every diagonal; every function is zero at the start of its axis and as given at the full travel."""
    volume = case.array("volume", shape=(3,))
    for name, part in case.at("types").items():
        given = part.at("value_at_full_travel")
        lines = [np.array([0.0, v]) for v in volume]
        tables = ParameterTables((lines[0], lines[1], lines[2]), _ramps(pair(given, "d")), _ramps(pair(given, "E")), squareness(given))
        found = space_diagonals(pahk_type(name), tables)
        exact = space_diagonals(pahk_type(name), tables, form="zyx")
        for key, stored in part.at("diagonals").named(*found):
            first, full = found[key].first_order_mm, exact[key].full_mm
            checks.compare("first order", first, stored.at("first_order"), unit="mm", floor=1e-13, rounding=SUBTRACTED, relative=0.0)
            checks.compare("full", full, stored.at("full"), unit="mm", floor=5e-13, rounding=SUBTRACTED, relative=0.0)


def _ramps(ends: F2) -> Triple:
    """Tables of two values: zero, and the row of each axis."""
    return np.stack([0.0 * ends[0], ends[0]]), np.stack([0.0 * ends[1], ends[1]]), np.stack([0.0 * ends[2], ends[2]])
