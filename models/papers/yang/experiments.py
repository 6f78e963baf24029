"""Experiments on Yang's machine as least-squares problems, to compare how well they could determine the 21 error functions.

The experiments are ball-bar helices about one or several cups, step diagonals with a flat mirror, plain diagonals, and whole vector maps,
with or without unknowns of the set-up. Coefficients are those of `abbe.models.papers.yang.complete.monomial_errors`. The number and
positions of the paper's cups (Fig. 6) are lost; the reference vectors use the centre and four cups at (±200, ±75) mm.
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
"""The two parts of a design matrix: columns of the machine's coefficients and columns of the set-up's unknowns."""
BAR_POINTS = 63
MAP_NODES = 7
"""Nodes per axis of a whole vector map; the rank does not depend on their number, and the effective rank hardly does."""
LONG_TOOL_MM = np.array([0.0, 0.0, 250.0])
LATERAL_TOOL_MM = np.array([100.0, 50.0, 150.0])
"""Second and third tool of the vector maps: a longer one, and one with a lateral offset."""
DEFAULT_OFFSETS_MM = ((-200.0, -75.0), (-200.0, 75.0), (200.0, -75.0), (200.0, 75.0))
"""Offsets of the four outer origins along the two axes across the hemisphere's axis (X and Z on the paper's horizontal machine)."""


@dataclass(frozen=True)
class YangPlan:
    """Volume, tool, cups, bars and steps of the experiments.

    Attributes
    ----------
    travel_mm, tool_mm : array, shape (3,)
        Travels of the scales, from 0; (Tx, Ty, Tz + L).
    origins_mm : array, shape (k, 3)
        Cup positions as scales; a single helix uses the first.
    radii_mm : tuple of float
        Bar lengths; a single helix uses the first.
    turns : float
        Turns of a helix of 63 points.
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
        """Refuse a plan without origins or bars."""
        if np.ndim(self.origins_mm) != 2 or np.shape(self.origins_mm)[1] != 3 or not len(self.origins_mm):
            raise ValueError(f"plan: origins must have shape (k, 3) with k of 1 or more, got {np.shape(self.origins_mm)}")
        if not self.radii_mm:
            raise ValueError("plan: at least one bar is needed")

    def field(self, tool_mm: F1 | None = None) -> Field:
        """Return the deviation per unit of each coefficient as a function of workpiece coordinates, for the plan's tool or another."""
        terms, tool = monomials(self.degree), self.tool_mm if tool_mm is None else tool_mm

        def at(points_mm: F2) -> F3:
            return monomial_field(terms, points_mm, self.travel_mm, tool)

        return at


def helix_rows(plan: YangPlan, origin_mm: F1, radius_mm: float) -> DesignRows:
    """Return the design rows of one ball-bar helix with pole in +Y, (8).

    Parameters
    ----------
    plan : YangPlan
    origin_mm : array, shape (3,)
        Cup as scales x, y, z (z of the cross slide).
    radius_mm : float

    Returns
    -------
    DesignRows
        Change of the bar's length, mm, per unit of each coefficient (`monomial_errors`), shape (63, p), and of cup offset (WORKPIECE
        coordinates) and bar length, shape (63, 4).

    Raises
    ------
    ValueError
        As in `helix_points`.
    """
    points = helix_points(origin_mm, radius_mm, turns=plan.turns, n=BAR_POINTS)
    return bar_rows(plan.field(), workpiece_mm(points), workpiece_mm(origin_mm))


def diagonal_rows(plan: YangPlan, *, sequential: bool = True) -> list[DesignRows]:
    """Return the design rows of the four laser diagonals ppp, npp, pnp, ppn, step order X, Y, Z.

    The names refer to the scales, whose z runs against the workpiece coordinate.
    """
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
    """Return two unit vectors across a beam, shape (2, 3)."""
    helper = np.eye(3)[int(np.argmin(np.abs(beam)))]
    first = np.cross(beam, helper)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(beam, first)])


def one_helix(plan: YangPlan, *, setup: bool) -> Problem:
    """Return experiment (a): one helix with the first bar about the first origin; with ``setup``, cup offset and bar length are unknown."""
    rows = helix_rows(plan, plan.origins_mm[0], plan.radii_mm[0])
    return rows.machine, rows.setup if setup else rows.setup[:, :0]


def all_helices(plan: YangPlan, *, centres: bool, lengths: Literal["none", "common", "each"] = "none") -> Problem:
    """Return experiment (b): helices with every bar about every origin.

    ``centres``: whether the cup offset of each origin is unknown. ``lengths``: bar lengths are known (``"none"``), have one unknown error
    (``"common"``) or one each (``"each"``); any other text raises ValueError.
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
    """Return experiment (d): four diagonals; with ``tilts``, two mirror tilts per diagonal are unknown."""
    rows = diagonal_rows(plan, sequential=sequential)
    per = 2 if tilts else 0
    return stacked([r.machine for r in rows], [(r.setup[:, :per], tuple(range(per * k, per * k + per))) for k, r in enumerate(rows)])


def together(first: Problem, second: Problem) -> Problem:
    """Combine two experiments; each keeps its own set-up unknowns."""
    k, m = first[1].shape[1], second[1].shape[1]
    return stacked([first[0], second[0]], [(first[1], tuple(range(k))), (second[1], tuple(range(k, k + m)))])


def vector_map(plan: YangPlan, tools_mm: tuple[F1, ...]) -> Problem:
    """Return experiment (e), an upper bound: the whole deviation vector on a grid over the volume, with each of the tools.

    Parameters
    ----------
    plan : YangPlan
    tools_mm : tuple of arrays (3,)
        (Tx, Ty, Tz + L) of each tool; the plan's own tool is not added.

    Returns
    -------
    machine, setup : array, shape (3 x 343 x tools, p) and (same, 0)
        mm per unit of each coefficient (`monomial_errors`), workpiece coordinates; there are no set-up unknowns.

    Raises
    ------
    ValueError
        There is no tool.
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
"""Experiments by their codes in the reference vectors."""


@dataclass(frozen=True, slots=True)
class OriginFit:
    """Result of `hemisphere_fits`: overhang of the hemisphere beyond the travel at each end of each axis (0: inside), mm, shape (3, 2)."""

    over_mm: F2

    @property
    def ok(self) -> bool:
        """Whether the hemisphere stays in the travel."""
        return bool((self.over_mm <= 0.0).all())


def origin_plan(stroke_mm: F2, offsets_mm: tuple[tuple[float, float], ...] = DEFAULT_OFFSETS_MM, *, axis: int = 1) -> F2:
    """Return origins: the centre of the bed and points about it, shape (1 + len(offsets), 3), mm, in the coordinates of ``stroke_mm``.

    Parameters
    ----------
    stroke_mm : array, shape (3, 2)
        Travel of X, Y, Z.
    offsets_mm : tuple of pairs
        Offsets from the centre along the two axes across ``axis``, in alphabetical order.
    axis : int
        Axis of the hemispheres (1: Y), on which the origins stand at the lower end of the travel.

    Raises
    ------
    ValueError
        ``stroke_mm`` is not a finite (3, 2) array of rising pairs, ``axis`` is not 0, 1 or 2, or an origin lies outside the travel.
        `hemisphere_fits` checks the hemisphere about it.
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
    """Check whether a hemisphere about ``origin_mm`` with its pole in +``axis`` stays in the travel.

    Parameters
    ----------
    origin_mm, stroke_mm : array, shape (3,) and (3, 2)
        Scales, mm.
    radius_mm : float

    Raises
    ------
    ValueError
        The radius is not positive, the origin is not three finite numbers, or strokes or axis are wrong as in `origin_plan`.
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
        raise ValueError(
            f"origins: strokes must be finite rising pairs of shape (3, 2), got shape {stroke.shape}; axis {axis} must be 0, 1 or 2"
        )
    return stroke
