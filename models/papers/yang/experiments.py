"""The experiments of math.md 4.6 on Yang's machine as least-squares problems: what each could tell about the 21 error functions.

Ball-bar helices about one or several cups, step diagonals with flat mirror, plain diagonals, and whole vector maps, with or without the
set-up unknowns. Coefficients are those of `abbe.models.papers.yang.complete.monomial_errors`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.functions.monomials import monomials
from abbe.models.geometry.volume import volume_grid
from abbe.models.notation.yang import workpiece_mm
from abbe.models.papers.yang.complete import monomial_field
from abbe.models.paths.helix import helix_points
from abbe.models.paths.lines import DIAGONALS, diagonal_ends, step_diagonal, straight_line
from abbe.models.solvers.designs import DesignRows, Field, bar_rows, laser_rows, stacked, vector_rows

Problem = tuple[F2, F2]
"""Machine columns and set-up columns of one problem."""
BAR_POINTS = 63
MAP_NODES = 7
"""Nodes per axis of a whole vector map. Not stated in math.md: the rank does not depend on it, the effective rank hardly."""
LONG_TOOL_MM = np.array([0.0, 0.0, 250.0])
LATERAL_TOOL_MM = np.array([100.0, 50.0, 150.0])
"""Second tool of math.md 4.6; a laterally offset one (its length is not stated there either)."""


@dataclass(frozen=True)
class YangPlan:
    """What was measured where.

    Attributes
    ----------
    travel_mm, tool_mm : array, shape (3,)
        Travels from 0 of the scales; (Tx, Ty, Tz + L).
    origins_mm : array, shape (k, 3)
        Cup positions, scales; the first is the one of the single helix.
    radii_mm : tuple of float
        Bars, the first is the one of the single helix.
    turns : float
        Turns of a helix (63 points).
    steps : int
        Steps per axis of a diagonal.
    degree : int
        Highest power of the error functions.
    """

    travel_mm: F1
    tool_mm: F1
    origins_mm: F2
    radii_mm: tuple[float, ...]
    turns: float
    steps: int
    degree: int

    def __post_init__(self) -> None:
        """Refuse a plan without origins, bars or travels."""
        if np.ndim(self.origins_mm) != 2 or np.shape(self.origins_mm)[1] != 3 or not len(self.origins_mm):
            raise ValueError(f"plan: origins must have shape (k, 3) with k of 1 or more, got {np.shape(self.origins_mm)}")
        if not self.radii_mm:
            raise ValueError("plan: at least one bar is needed")

    def field(self, tool_mm: F1 | None = None) -> Field:
        """Deviation at workpiece coordinates per unit of each coefficient, for the plan's tool or another."""
        terms, tool = monomials(self.degree), self.tool_mm if tool_mm is None else tool_mm

        def at(points_mm: F2) -> F3:
            return monomial_field(terms, points_mm, self.travel_mm, tool)

        return at


def helix_rows(plan: YangPlan, origin_mm: F1, radius_mm: float) -> DesignRows:
    """Ball-bar rows of one helix with pole in +Y, eq (8) of Yang (math.md 4.2, 4.3).

    Parameters
    ----------
    plan : YangPlan
    origin_mm : array, shape (3,)
        Cup, scales x, y, z (z of the cross slide); so lies the path.
    radius_mm : float

    Returns
    -------
    Rows
        Change of the bar's length, mm, per unit of each coefficient (`monomial_errors`), shape (63, p), and of cup offset (WORKPIECE
        coordinates) and bar length, shape (63, 4).

    Raises
    ------
    ValueError
        As `helix_points`.
    """
    points = helix_points(origin_mm, radius_mm, turns=plan.turns, n=BAR_POINTS)
    return bar_rows(plan.field(), workpiece_mm(points), workpiece_mm(origin_mm))


def diagonal_rows(plan: YangPlan, *, sequential: bool = True) -> list[DesignRows]:
    """Laser rows of the four diagonals ppp, npp, pnp, ppn OF THE SCALES (not of the workpiece: z runs the other way), order X, Y, Z."""
    box = np.stack([np.zeros(3), plan.travel_mm], axis=1)
    out = []
    for name in DIAGONALS:
        start, end = diagonal_ends(box, name)
        scales = step_diagonal(start, end, plan.steps, back=False) if sequential else straight_line(start, end, plan.steps + 1, back=False)
        path = workpiece_mm(scales)
        beam = (path[-1] - path[0]) / np.linalg.norm(path[-1] - path[0])
        out.append(laser_rows(plan.field(), path, beam, across(beam)))
    return out


def across(beam: F1) -> F2:
    """Any two unit vectors across a beam, shape (2, 3)."""
    helper = np.eye(3)[int(np.argmin(np.abs(beam)))]
    first = np.cross(beam, helper)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(beam, first)])


def one_helix(plan: YangPlan, *, setup: bool) -> Problem:
    """(a) one helix with the first bar about the first origin, set-up perfect or cup offset and bar length unknown."""
    rows = helix_rows(plan, plan.origins_mm[0], plan.radii_mm[0])
    return rows.machine, rows.setup if setup else rows.setup[:, :0]


def all_helices(plan: YangPlan, *, centres: bool, lengths: Literal["none", "common", "each"] = "none") -> Problem:
    """(b) every origin with every bar; a cup offset per origin; bar lengths ``"none"`` known, ``"common"`` or ``"each"`` unknown.

    Raises
    ------
    ValueError
        Another word for ``lengths``.
    """
    unknown_lengths = {"none": 0, "common": 1, "each": len(plan.radii_mm)}
    if lengths not in unknown_lengths:
        raise ValueError(f"helices: lengths {lengths!r} must be 'none', 'common' or 'each'")
    n_lengths = unknown_lengths[lengths]
    parts, setups = [], []
    for i, origin in enumerate(plan.origins_mm):
        for j, radius in enumerate(plan.radii_mm):
            rows = helix_rows(plan, origin, radius)
            length = () if n_lengths == 0 else (0,) if n_lengths == 1 else (j,)
            cup = tuple(n_lengths + 3 * i + k for k in range(3)) if centres else ()
            parts.append(rows.machine)
            setups.append((np.concatenate([rows.setup[:, : len(cup)], rows.setup[:, 3 : 3 + len(length)]], axis=1), cup + length))
    return stacked(parts, setups)


def step_diagonals(plan: YangPlan, *, tilts: bool, sequential: bool = True) -> Problem:
    """(d) four diagonals, mirrors ideal or two tilts unknown per diagonal."""
    rows = diagonal_rows(plan, sequential=sequential)
    per = 2 if tilts else 0
    return stacked([r.machine for r in rows], [(r.setup[:, :per], tuple(range(per * k, per * k + per))) for k, r in enumerate(rows)])


def together(first: Problem, second: Problem) -> Problem:
    """Two experiments with set-up unknowns of their own."""
    k, m = first[1].shape[1], second[1].shape[1]
    return stacked([first[0], second[0]], [(first[1], tuple(range(k))), (second[1], tuple(range(k, k + m)))])


def vector_map(plan: YangPlan, tools_mm: tuple[F1, ...]) -> Problem:
    """Upper bound: the whole deviation vector on a grid over the volume, with each of the tools (math.md 4.6).

    Parameters
    ----------
    plan : YangPlan
    tools_mm : tuple of arrays (3,)
        (Tx, Ty, Tz + L) of each tool; the plan's own tool is not added.

    Returns
    -------
    machine, setup : array, shape (3 x 343 x tools, p) and (same, 0)
        mm per unit of each coefficient (`monomial_errors`), workpiece coordinates; nothing is unknown about the set-up.

    Raises
    ------
    ValueError
        No tool.
    """
    if not tools_mm:
        raise ValueError("vector map: at least one tool is needed")
    grid = workpiece_mm(volume_grid(np.stack([np.zeros(3), plan.travel_mm], axis=1), MAP_NODES))
    a = np.concatenate([vector_rows(plan.field(tool), grid).machine for tool in tools_mm])
    return a, np.zeros((len(a), 0))


Experiment = Callable[[YangPlan], Problem]
EXPERIMENTS: dict[str, Experiment] = {
    "e1": lambda p: vector_map(p, (p.tool_mm,)),
    "e2": lambda p: vector_map(p, (p.tool_mm, LONG_TOOL_MM)),
    "e3": lambda p: vector_map(p, (p.tool_mm, LONG_TOOL_MM, LATERAL_TOOL_MM)),
    "a1": lambda p: one_helix(p, setup=False),
    "a2": lambda p: one_helix(p, setup=True),
    "b1": lambda p: all_helices(p, centres=False),
    "b2": lambda p: all_helices(p, centres=True),
    "b3": lambda p: all_helices(p, centres=True, lengths="common"),
    "b4": lambda p: all_helices(p, centres=True, lengths="each"),
    "c1": lambda p: together(one_helix(p, setup=True), step_diagonals(p, tilts=False)),
    "c2": lambda p: together(one_helix(p, setup=True), step_diagonals(p, tilts=True)),
    "c3": lambda p: together(all_helices(p, centres=True, lengths="common"), step_diagonals(p, tilts=True)),
    "c3'": lambda p: together(all_helices(p, centres=True, lengths="common"), step_diagonals(p, tilts=False)),
    "d1": lambda p: step_diagonals(p, tilts=False),
    "d2": lambda p: step_diagonals(p, tilts=True),
    "d3": lambda p: step_diagonals(p, tilts=False, sequential=False),
}
"""Experiments of math.md 4.6 by the letters of the vectors."""
