"""Everything that could be measured on a machine without hitting anything: helices, edge lines, body diagonals.

Collision-free means: the whole path lies inside the strokes less a clearance; hemispheres open upwards along the vertical axis, so that
neither the bar nor the spindle comes below the cup; laser paths stay inside the strokes.
"""

from __future__ import annotations

from itertools import permutations, product

import numpy as np

from models.arrays import F1
from models.machine import Machine
from models.paths.lines import DIAGONALS
from models.planning.instruments import Instruments
from models.planning.measurements import CLEARANCE_MM, DiagonalTest, HelixTest, LineTest, Measurement, Point

BAR_CLEARANCE_MM = 5.0
"""Hemispheres keep this distance from the ends of the strokes: approach, lost motion and cup offset need some."""
EDGES = (0.1, 0.5, 0.9)
"""Relative places of laser lines across the two other axes."""
ORDERS = tuple("".join(p) for p in permutations("XYZ"))


def candidates(machine: Machine, tools: Instruments, vertical: int = 2) -> tuple[Measurement, ...]:
    """All measurements that the planner may choose from, helices first.

    Parameters
    ----------
    vertical : int
        Index of the vertical axis: hemispheres open along it.

    Raises
    ------
    ValueError
        Nothing fits into the strokes.
    """
    found: list[Measurement] = []
    for radius in sorted(tools.bar_lengths_mm):
        found += [HelixTest(c, radius, axis=vertical) for c in helix_centres(machine, radius, vertical)]
    if tools.laser and (machine.length_mm > 4 * CLEARANCE_MM).all():
        found += [LineTest(a, (u, v)) for a in range(3) for u, v in product(EDGES, repeat=2)]
        found += [DiagonalTest(d, order) for d in DIAGONALS for order in (*ORDERS, "")]
    if not found:
        raise ValueError("planner: no helix of the bars at hand and no laser path fits into the strokes")
    return tuple(found)


def _room(machine: Machine, radius_mm: float, vertical: int) -> tuple[F1, F1]:
    """Lowest and highest cup place (whole mm) at which the upper hemisphere of a radius stays inside the strokes."""
    below = np.full(3, radius_mm + BAR_CLEARANCE_MM)
    below[vertical] = BAR_CLEARANCE_MM
    return np.ceil(machine.stroke_mm[:, 0] + below), np.floor(machine.stroke_mm[:, 1] - radius_mm - BAR_CLEARANCE_MM)


def bars_that_fit(machine: Machine, tools: Instruments, centre_mm: Point, vertical: int = 2) -> tuple[float, ...]:
    """Bars whose whole upper hemisphere about a cup stays inside the strokes."""
    fit = []
    for radius in tools.bar_lengths_mm:
        lo, hi = _room(machine, radius, vertical)
        if (lo <= centre_mm).all() and (centre_mm <= hi).all():
            fit.append(radius)
    return tuple(fit)


def helix_centres(machine: Machine, radius_mm: float, vertical: int = 2) -> tuple[Point, ...]:
    """Cup places (whole mm) at which the whole upper hemisphere of a radius stays inside the strokes."""
    lo, hi = _room(machine, radius_mm, vertical)
    if (hi < lo).any():
        return ()
    places = []
    for a in range(3):
        room = hi[a] - lo[a]
        n = 1 if room < 0.2 * radius_mm else 2 if room < 0.7 * radius_mm else 3
        places.append([float(v) for v in np.round(np.linspace(lo[a], hi[a], n) if n > 1 else [0.5 * (lo[a] + hi[a])])])
    return tuple((x, y, z) for x, y, z in product(*places))
