"""All collision-free measurements on a machine: helices, edge lines, body diagonals.

Collision-free means: the whole path lies inside the strokes less a clearance; hemispheres open towards the spindle, so that it never comes
beyond the cup (`opening`); laser paths stay inside the strokes.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from abbe.models.arrays import F1
from abbe.models.machine import AXES, Machine
from abbe.models.paths.lines import DIAGONALS
from abbe.models.planning.instruments import Instruments
from abbe.models.planning.measurements import CLEARANCE_MM, DiagonalTest, HelixTest, LineTest, Measurement, Point

BAR_CLEARANCE_MM = 5.0
"""Hemispheres keep this distance from the ends of the strokes: approach, lost motion and cup offset need some."""
EDGES = (0.1, 0.5, 0.9)
"""Relative places of laser lines across the two other axes."""
ORDERS = tuple("".join(p) for p in permutations("XYZ"))
SHORTEST_TOOL_MM = 1.0
"""A shorter tool does not show the side of the spindle."""
OBLIQUE = 0.5
"""Second longest component of a tool over its longest, from which on the spindle's direction is doubtful."""


@dataclass(frozen=True, slots=True)
class Opening:
    """Where hemispheres open: ``side`` (1 or -1) of ``axis``; ``warning``: why that may be wrong; empty where the tool states it."""

    axis: int
    side: int
    warning: str = ""

    @property
    def text(self) -> str:
        """For example +Z."""
        return f"{'+' if self.side > 0 else '-'}{AXES[self.axis]}"


def opening(machine: Machine, vertical: int = 2) -> Opening:
    """Side on which the spindle is, seen from the cup: against the tool, which reaches from the spindle to the ball.

    Without a known tool: the upper side of the vertical axis, which is right for a vertical spindle.
    """
    longest = int(np.argmax(np.abs(machine.tool_mm)))
    sizes = np.sort(np.abs(machine.tool_mm))
    if sizes[2] < SHORTEST_TOOL_MM:
        reason = f"hemispheres open along +{AXES[vertical]}, the vertical axis: without tool_mm nothing says where the spindle is"
        return Opening(vertical, 1, f"{reason}; if it is horizontal, state tool_mm in the machine file, else it may meet the cup")
    found = Opening(longest, -1 if machine.tool_mm[longest] > 0 else 1)
    if sizes[1] < OBLIQUE * sizes[2]:
        return found
    tool = ", ".join(f"{v:g}" for v in machine.tool_mm)
    warning = (
        f"hemispheres open along {found.text}, against the longest part of tool_mm ({tool}): it is oblique, look where the spindle goes"
    )
    return Opening(found.axis, found.side, warning)


def candidates(machine: Machine, tools: Instruments, vertical: int = 2) -> tuple[Measurement, ...]:
    """All measurements that the planner may choose from, helices first.

    Parameters
    ----------
    vertical : int
        Index of the vertical axis: hemispheres open along it if the tool does not show the side of the spindle (`opening`).

    Raises
    ------
    ValueError
        Nothing fits into the strokes.
    """
    found: list[Measurement] = []
    spindle = opening(machine, vertical)
    for radius in sorted(tools.bar_lengths_mm):
        found += [HelixTest(c, radius, axis=spindle.axis, opens=spindle.side) for c in helix_centres(machine, radius, spindle)]
    if tools.laser and (machine.length_mm > 4 * CLEARANCE_MM).all():
        found += [LineTest(a, (u, v)) for a in range(3) for u, v in product(EDGES, repeat=2)]
        found += [DiagonalTest(d, order) for d in DIAGONALS for order in (*ORDERS, "")]
    if not found:
        raise ValueError("planner: no helix of the bars at hand and no laser path fits into the strokes")
    return tuple(found)


def _room(machine: Machine, radius_mm: float, spindle: Opening) -> tuple[F1, F1]:
    """Lowest and highest cup place (whole mm) at which the hemisphere of a radius stays inside the strokes."""
    below, above = np.full(3, radius_mm + BAR_CLEARANCE_MM), np.full(3, radius_mm + BAR_CLEARANCE_MM)
    (below if spindle.side > 0 else above)[spindle.axis] = BAR_CLEARANCE_MM
    return np.ceil(machine.stroke_mm[:, 0] + below), np.floor(machine.stroke_mm[:, 1] - above)


def bars_that_fit(machine: Machine, tools: Instruments, test: HelixTest) -> tuple[float, ...]:
    """Bars whose whole hemisphere about the cup of a helix stays inside the strokes."""
    fit = []
    for radius in tools.bar_lengths_mm:
        lo, hi = _room(machine, radius, Opening(test.axis, test.opens))
        if (lo <= test.centre_mm).all() and (test.centre_mm <= hi).all():
            fit.append(radius)
    return tuple(fit)


def helix_centres(machine: Machine, radius_mm: float, spindle: Opening) -> tuple[Point, ...]:
    """Cup places (whole mm) at which the whole hemisphere of a radius stays inside the strokes."""
    lo, hi = _room(machine, radius_mm, spindle)
    if (hi < lo).any():
        return ()
    places = []
    for a in range(3):
        room = hi[a] - lo[a]
        n = 1 if room < 0.2 * radius_mm else 2 if room < 0.7 * radius_mm else 3
        places.append([float(v) for v in np.round(np.linspace(lo[a], hi[a], n) if n > 1 else [0.5 * (lo[a] + hi[a])])])
    return tuple((x, y, z) for x, y, z in product(*places))
