"""The experiments of math.md 4.6 on Yang's machine as least-squares problems: what each could tell about the 21 error functions.

Ball-bar helices about one or several cups, step diagonals with flat mirror, plain diagonals, and whole vector maps, with or without the
set-up unknowns. Coefficients are those of `abbe.models.papers.yang.complete.monomial_errors`. Number and places of the paper's cups (Fig.
6) are lost; centre plus four at (±200, ±75) mm is the plan of the reference vectors (math.md 4.3).
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
from abbe.models.paths import DIAGONALS, diagonal_ends, helix_points, step_diagonal, straight_line
from abbe.models.solvers.designs import DesignRows, Field, bar_rows, laser_rows, stacked, vector_rows

Problem = tuple[F2, F2]
"""Machine columns and set-up columns of one problem."""
BAR_POINTS = 63
MAP_NODES = 7
"""Nodes per axis of a whole vector map. Not stated in math.md: the rank does not depend on it, the effective rank hardly."""
LONG_TOOL_MM = np.array([0.0, 0.0, 250.0])
LATERAL_TOOL_MM = np.array([100.0, 50.0, 150.0])
"""Second tool of math.md 4.6; a laterally offset one (its length is not stated there either)."""
DEFAULT_OFFSETS_MM = ((-200.0, -75.0), (-200.0, 75.0), (200.0, -75.0), (200.0, 75.0))
"""Offsets of the four outer origins in the two axes across the hemisphere's axis (X and Z of the paper's horizontal machine)."""


@dataclass(frozen=True)
class YangPlan:
    """A plan: volume, tool, cups, bars and steps of the experiments.

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
"""Experiments of math.md 4.6 by the letters of the reference vectors."""


@dataclass(frozen=True, slots=True)
class OriginFit:
    """Whether a hemisphere fits: how far it leaves the travel at each end of each axis (0 inside), mm, shape (3, 2)."""

    over_mm: F2

    @property
    def ok(self) -> bool:
        """Nothing leaves the travel."""
        return bool((self.over_mm <= 0.0).all())


def origin_plan(stroke_mm: F2, offsets_mm: tuple[tuple[float, float], ...] = DEFAULT_OFFSETS_MM, *, axis: int = 1) -> F2:
    """Origins: the centre of the bed and points about it, shape (1 + len(offsets), 3), mm, in the coordinates of ``stroke_mm``.

    Parameters
    ----------
    stroke_mm : array, shape (3, 2)
        Travel of X, Y, Z.
    offsets_mm : tuple of pairs
        Offsets from the centre along the two axes across ``axis``, in alphabetic order.
    axis : int
        Axis of the hemispheres, 1 = Y: there the origin stands at the small end of the travel.

    Raises
    ------
    ValueError
        ``stroke_mm`` is not a finite (3, 2) array of rising pairs, ``axis`` is not 0, 1 or 2, or an origin would lie outside the travel (or
        nowhere). Whether a hemisphere fits about it, `hemisphere_fits` tells.
    """
    stroke = _stroke(stroke_mm, axis)
    centre = stroke.mean(axis=1)
    centre[axis] = stroke[axis, 0]
    across = [a for a in range(3) if a != axis]
    out = np.tile(centre, (1 + len(offsets_mm), 1))
    for k, pair in enumerate(offsets_mm):
        if np.shape(pair) != (2,):
            raise ValueError(f"origins: offset {k + 1} must be two numbers, got {pair!r}")
        out[k + 1, across] += pair
    inside = ((out >= stroke[:, 0]) & (out <= stroke[:, 1])).all(axis=1)
    if not inside.all():
        k = int(np.argmin(inside))
        raise ValueError(f"origins: origin {k} at {', '.join(f'{v:g}' for v in out[k])} mm lies outside the travel, give smaller offsets")
    return out


def hemisphere_fits(origin_mm: F1, radius_mm: float, stroke_mm: F2, *, axis: int = 1) -> OriginFit:
    """Whether a hemisphere about ``origin_mm`` with its pole in +``axis`` stays in the travel.

    Parameters
    ----------
    origin_mm, stroke_mm : array, shape (3,) and (3, 2)
        Scales, mm.
    radius_mm : float

    Raises
    ------
    ValueError
        Radius not positive, origin not three finite numbers, strokes or axis as `origin_plan`.
    """
    stroke = _stroke(stroke_mm, axis)
    if not 0 < radius_mm < np.inf:
        raise ValueError(f"hemisphere: radius {radius_mm} mm must be positive")
    o = np.asarray(origin_mm, dtype=np.float64)
    if o.shape != (3,) or not np.isfinite(o).all():
        raise ValueError(f"hemisphere: the origin must be three finite numbers, got {origin_mm!r}")
    low, high = o - radius_mm, o + radius_mm
    low[axis] = o[axis]
    return OriginFit(np.maximum(np.stack([stroke[:, 0] - low, high - stroke[:, 1]], axis=1), 0.0))


def _stroke(stroke_mm: F2, axis: int) -> F2:
    stroke = np.asarray(stroke_mm, dtype=np.float64)
    if stroke.shape != (3, 2) or not np.isfinite(stroke).all() or not (stroke[:, 1] > stroke[:, 0]).all() or axis not in (0, 1, 2):
        raise ValueError(f"origins: strokes of shape {stroke.shape} must be (3, 2) and growing, axis {axis} one of 0, 1, 2")
    return stroke
