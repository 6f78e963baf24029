"""Achievable accuracy of each kind of table on this machine: residual errors of distances with their uncertainty.

All kinds are made from the same identified deviation; its unknown part (`PredictedDistances.unknown_mm`) is in every row. The errors are
those over the inner 80 % of the strokes, to first order; distances do not contain rigid motion.

Tables of single error motions, for controls that store up to 21 of them and compute the deviation by their own kinematic model.

One campaign with one tool does not determine every single motion: turning and shifting a carriage look alike at one tool length (math.md
4.6). A motion that the data do not separate from others is not written under its name. The caller chooses by naming the motions:

- only motions that are observable by themselves (`individually_observable`, the default): valid for every tool, but motions that are known
  only together with a hidden one, or are mostly an assumption, stay uncorrected;
- `enough_for_the_field`: as few motions as carry the whole deviation; the others are zero. Valid at this tool length only, and so labelled.

In the first case every motion has its own estimate; in the second the written motions also carry the effect of the others at this tool.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from abbe.models.arrays import F1, F2, F3
from abbe.models.compensation.additive import SQUARENESS_SLOPES, MeanParameter, mean_parameter
from abbe.models.compensation.distances import (
    Correction,
    Pairs,
    PredictedDistances,
    correction_error_mm,
    inner_box_mm,
    predict_distances,
    random_pairs,
)
from abbe.models.compensation.grid import Mask, grid_table, quantise_grid
from abbe.models.compensation.tables import NineTables, entry_u, grid_positions, nine_tables, quantise, table_design
from abbe.models.functions.motions import PLACES, SQUARENESS
from abbe.models.geometry.bases import term_values
from abbe.models.geometry.chain import design, deviation_mm, squareness_motions
from abbe.models.geometry.volume import rigid_design, volume_grid
from abbe.models.machine import Machine
from abbe.models.solvers.assessment import motions_of
from abbe.models.solvers.joint import JointSolution
from abbe.models.solvers.observability.rank import observable_motions
from abbe.models.uncertainty.sources import ErrorSources, error_sources, variances

NODES = 7
RANK_TOLERANCE = 1e-7
TOWARDS_ESTIMATE = 1e-6
"""Weight of a motion's own estimate against reproducing the deviation: it decides only combinations that the deviation leaves open."""


@dataclass(frozen=True, eq=False)
class MotionTables:
    """Error motions (not corrections: the control changes the sign) at the grid of their axis.

    Attributes
    ----------
    machine : Machine
        Nominal machine, with the tool for which the tables hold.
    position_mm : three arrays
    motions, u : dict
        ``"EXX"`` ..: values at the grid of the moving axis, mm or rad, and their standard uncertainty. Motions that are missing are zero.
    squareness_rad, u_squareness_rad : dict
        ``"C0Y"`` ..; travel counts from the start of the stroke.
    left_out : tuple of str
        Motions that are not written: hidden, weak, or not named by the caller.
    any_tool : bool
        Whether every motion in the tables is observable by itself, so that they hold for any tool.
    """

    machine: Machine
    position_mm: tuple[F1, F1, F1]
    motions: dict[str, F1]
    u: dict[str, F1]
    squareness_rad: dict[str, float]
    u_squareness_rad: dict[str, float]
    left_out: tuple[str, ...]
    any_tool: bool

    def correction_at(self, axes_mm: F2, tool_mm: F1 | None = None) -> F2:
        """What a control adds to commanded positions, shape (n, 3), mm: straight lines between nodes, rule G for the levers."""
        values = np.zeros((axes_mm.shape[0], 3, 6))
        for name, table in self.motions.items():
            axis, component = PLACES[name]
            values[:, axis, component] = np.interp(axes_mm[:, axis], self.position_mm[axis], table)
        angles = np.array([self.squareness_rad.get(name, 0.0) for name in SQUARENESS])
        values += squareness_motions(axes_mm, self.machine.stroke_mm[:, 0]) @ angles
        return -deviation_mm(self.machine, axes_mm, values, tool_mm)


def motion_tables(
    solution: JointSolution,
    counts: tuple[int, int, int],
    motions: frozenset[str] | set[str] | None = None,
    *,
    any_tool: bool = True,
    sources: ErrorSources | None = None,
) -> MotionTables:
    """Tables of the named motions only; the others are listed in ``left_out``.

    Parameters
    ----------
    counts : (int, int, int)
        Grid points of X, Y, Z.
    motions : set of str, optional
        Motions to write: ``"EXX"`` .. ``"ECZ"``, ``"C0Y"``, ``"B0Z"``, ``"A0Z"``. Default: all that are observable by themselves.
    any_tool : bool
        True: each motion has its own estimate, and only what is observable by itself may be written. False, for `enough_for_the_field`:
        values that reproduce the identified deviation with the machine's own tool best, all others being zero.
    sources : ErrorSources, optional
        Sources of uncertainty, with the stated inputs they rest on; default: ``error_sources(solution)``, so the documented inputs.

    Raises
    ------
    ValueError
        A name that is not a motion of the solution, no name at all, or (``any_tool``) a motion that the data do not separate from others.
    """
    known = {t.motion for t in solution.terms}
    motions = _writable(solution, known, motions, any_tool)
    sources = sources or error_sources(solution)
    grids = grid_positions(solution.machine, counts)
    keep = [i for i, t in enumerate(sources.terms) if t.motion in motions]  # the solution's own, then orders above it, that have no value
    operator = np.eye(len(sources.terms))[keep]
    if not any_tool:
        n, own = len(solution.terms), [i for i in keep if i < len(solution.terms)]
        operator[: len(own), :n] = _refit(solution, own)
    entries = {name: _entries(sources, name, grids, keep, operator) for name in sorted(motions)}
    functions = {n: e for n, e in entries.items() if n not in SQUARENESS}
    square = {n: e for n, e in entries.items() if n in SQUARENESS}
    return MotionTables(
        solution.machine,
        grids,
        {n: e[0] for n, e in functions.items()},
        {n: e[1] for n, e in functions.items()},
        {n: float(e[0][0]) for n, e in square.items()},
        {n: float(e[1][0]) for n, e in square.items()},
        tuple(sorted(known - motions)),
        any_tool,
    )


def _writable(solution: JointSolution, known: set[str], motions: frozenset[str] | set[str] | None, any_tool: bool) -> frozenset[str]:
    """The motions to be written, if they may be."""
    observable_names = individually_observable(solution) if motions is None or any_tool else frozenset(known)
    wanted = observable_names if motions is None else frozenset(motions)
    if not wanted or not wanted <= known:
        raise ValueError(f"motion tables: {', '.join(sorted(wanted - known)) or 'no motion'} cannot be written")
    if not wanted <= observable_names:
        raise ValueError(
            f"motion tables: {', '.join(sorted(wanted - observable_names))} cannot be written under their own names: the readings do not "
            "tell them apart from other motions. Measure with a second tool length, or make tables for this tool only (any_tool=False)"
        )
    return wanted


def _entries(sources: ErrorSources, name: str, grids: tuple[F1, F1, F1], keep: list[int], operator: F2) -> tuple[F1, F1]:
    """Values and standard uncertainties of one motion on the grid of its axis; of a squareness one value (rad)."""
    machine = sources.solution.machine
    mine = [k for k, i in enumerate(keep) if sources.terms[i].motion == name]
    terms = tuple(sources.terms[keep[k]] for k in mine)
    axis = terms[0].axis
    points = np.tile(machine.centre_mm, (grids[axis].size, 1))
    points[:, axis] = grids[axis]
    rows = np.ones((1, 1)) if name in SQUARENESS else term_values(terms, points, machine.stroke_mm)
    gradient = rows @ operator[mine]
    return gradient @ sources.coefficients, np.sqrt(variances(sources, gradient))


def individually_observable(solution: JointSolution, *, weak: bool = False) -> frozenset[str]:
    """Motions that the report on this solution calls observed (with ``weak``: or weak), by the same rule (`observable_motions`).

    None of their coefficients is in a hidden combination, and the readings carry at least 90 % (10 %) of their information.
    """
    return frozenset(observable_motions(motions_of(solution), weak=weak))


def enough_for_the_field(solution: JointSolution) -> frozenset[str]:
    """Motions that carry the deviation with the machine's own tool when all others are zero; angles are given up first."""
    field = _field(solution)
    triangle = scipy.linalg.qr(field / np.maximum(np.linalg.norm(field, axis=0), 1e-300), mode="r")[0][: field.shape[1]]
    names = [*[t.motion for t in solution.terms], *["rigid"] * 6]

    def rank(motions: set[str]) -> int:
        at = [i for i, n in enumerate(names) if n == "rigid" or n in motions]
        return int(np.linalg.matrix_rank(triangle[:, at], tol=RANK_TOLERANCE))

    kept = {t.motion for t in solution.terms}
    whole = rank(kept)
    motions = {(t.component, t.axis): t.motion for t in solution.terms if t.order > 0}
    for _, name in sorted(motions.items(), reverse=True):
        if rank(kept - {name}) == whole:
            kept = kept - {name}
    return frozenset(kept)


def _field(solution: JointSolution) -> F2:
    """Deviation over the volume per unit of every coefficient, then of the six rigid motions, shape (3 points, terms + 6)."""
    grid = volume_grid(solution.machine.stroke_mm, max(NODES, max(t.order for t in solution.terms) + 2))
    full = design(solution.machine, solution.terms, grid).reshape(3 * len(grid), -1)
    return np.concatenate([full, rigid_design(grid).reshape(-1, 6)], axis=1)


def _refit(solution: JointSolution, keep: list[int]) -> F2:
    """Coefficients of the kept terms that reproduce the whole deviation best, per unit of every coefficient, shape (kept, terms)."""
    n = len(solution.terms)
    field = _field(solution)
    weight = TOWARDS_ESTIMATE * np.sqrt(len(field))
    near = np.zeros((len(keep), n))
    near[np.arange(len(keep)), keep] = weight * np.linalg.norm(field[:, keep], axis=0) / np.sqrt(len(field))
    a = np.concatenate([field[:, keep], field[:, n:]], axis=1)
    ridge = np.concatenate([near[:, keep], np.zeros((len(keep), 6))], axis=1)
    return np.asarray(np.linalg.lstsq(np.concatenate([a, ridge]), np.concatenate([field[:, :n], near]), rcond=None)[0][: len(keep)])


# Tables for controllers that take less than nine: positioning alone, cross tables beside it, squareness as a parameter.
#
# No correction is in two parts, and all parts together correct the same as the nine tables (but for a rotation of the frame, which
# squareness parameters cannot express and which changes no distance).


def positioning_only(tables: NineTables) -> NineTables:
    """The three own-axis tables of nine (pitch error compensation), everything else zero."""
    return _kept(tables, lambda a: np.arange(3) == a)


def cross_only(tables: NineTables) -> NineTables:
    """The six cross tables of nine, own-axis tables zero: to be used beside `positioning_only`, which contains the scale."""
    return _kept(tables, lambda a: np.arange(3) != a)


@dataclass(frozen=True, eq=False)
class SquarenessTables:
    """Squareness as three parameters (C0Y, B0Z, A0Z, rad, with u), and tables without squareness.

    The parameters are the squareness of these tables, which count the body diagonals as much as the volume: not the mean squareness over
    the volume (`abbe.models.compensation.additive.mean_linear`), from which it can differ by more than its uncertainty.

    ``tables``: own-axis tables as before; cross tables without slope, so straightness alone. The rest of their slopes was a rotation of the
    frame and is left out. ``start_mm``: position of each axis at which the parameters correct nothing.
    """

    parameters: tuple[MeanParameter, ...]
    tables: NineTables
    start_mm: F1

    def squareness_at(self, axes_mm: F2) -> F2:
        """Correction by the parameters alone at commanded positions, shape (n, 3), mm: +C0Y y to X, −B0Z z to X, +A0Z z to Y."""
        out = np.zeros((axes_mm.shape[0], 3))
        for parameter, (_, first, second, sign) in zip(self.parameters, SQUARENESS_SLOPES, strict=True):
            out[:, first] -= sign * parameter.value * (axes_mm[:, second] - self.start_mm[second])
        return out

    def correction_at(self, axes_mm: F2) -> F2:
        """Parameters and tables together, shape (n, 3), mm."""
        return self.squareness_at(axes_mm) + self.tables.correction_at(axes_mm)


def squareness_tables(
    solution: JointSolution, counts: tuple[int, int, int], *, nodes: int = 9, sources: ErrorSources | None = None
) -> SquarenessTables:
    """Nine tables with squareness taken out of them; parameters as `nine_tables`.

    The squareness parameters are least-squares slopes of the tables themselves, and their uncertainty that of the same slopes.
    """
    sources = sources or error_sources(solution)
    nine = nine_tables(solution, counts, nodes=nodes, sources=sources)
    grids = grid_positions(solution.machine, counts)
    corrections: list[F2] = []
    uncertainties: list[F2] = []
    slopes: list[F2] = []  # of outputs over axis a, per unit of every coefficient, (3, terms)
    for a, columns in enumerate(table_design(solution, grids, nodes, sources.terms)):
        cross = np.arange(3) != a
        travel = grids[a] - grids[a][0]
        weight = (travel - travel.mean()) / np.sum((travel - travel.mean()) ** 2)
        slopes.append(np.einsum("n,nik->ik", weight, columns))
        straight: F3 = columns - travel[:, None, None] * slopes[a]
        corrections.append(np.where(cross, -(straight @ sources.coefficients), nine.correction_mm[a]))
        uncertainties.append(np.where(cross, entry_u(sources, straight), nine.u_mm[a]))
    found = tuple(mean_parameter(sources, name, sign * (slopes[a][b] + slopes[b][a])) for name, a, b, sign in SQUARENESS_SLOPES)
    tables = NineTables(grids, (corrections[0], corrections[1], corrections[2]), (uncertainties[0], uncertainties[1], uncertainties[2]))
    return SquarenessTables(found, tables, np.array([g[0] for g in grids]))


def _kept(tables: NineTables, keep: Callable[[int], np.ndarray[tuple[int, ...], np.dtype[np.bool_]]]) -> NineTables:
    corrections = [np.where(keep(a), tables.correction_mm[a], 0.0) for a in range(3)]
    uncertainties = [np.where(keep(a), tables.u_mm[a], 0.0) for a in range(3)]
    return NineTables(
        tables.position_mm, (corrections[0], corrections[1], corrections[2]), (uncertainties[0], uncertainties[1], uncertainties[2])
    )


ONE_AXIS_COUNTS = (25, 25, 25)
GRID_NODES = (5, 9, 13, 17)


@dataclass(frozen=True)
class Achievable:
    """One kind of table.

    Attributes
    ----------
    kind : str
        Name for the user.
    entries : int
        Number of values in the controller.
    distances : PredictedDistances
        Residual errors with the table as stored, rounding included.
    rounding_mm : float
        Rms share of the distance errors that comes from rounding to the controller's unit alone; 0 without a unit.
    """

    kind: str
    entries: int
    distances: PredictedDistances
    rounding_mm: float


def achievable(
    solution: JointSolution,
    *,
    counts: tuple[int, int, int] = ONE_AXIS_COUNTS,
    grid_nodes: tuple[int, ...] = GRID_NODES,
    lsb_mm: float = 0.0,
    observable: frozenset[str] | None = None,
    sources: ErrorSources | None = None,
) -> tuple[Achievable, ...]:
    """Every kind of table on this machine, from none to the finest grid.

    Parameters
    ----------
    counts : (int, int, int)
        Points of one-axis tables on X, Y, Z.
    grid_nodes : tuple of int
        Nodes per axis of the 3-D grids.
    lsb_mm : float
        The controller's unit; 0: no rounding. Tables of single motions and squareness parameters are not rounded.
    observable : set of str, optional
        Motions that are observable by themselves; default: `individually_observable`.
    sources : ErrorSources, optional
        Sources of uncertainty, with the stated inputs they rest on; default: ``error_sources(solution)``, so the documented inputs.
    """
    judge = _ResidualJudge(solution, random_pairs(inner_box_mm(solution.machine)), sources or error_sources(solution), lsb_mm)
    rows = [judge.row("no table", 0), *judge.one_axis(counts), *judge.single_motions(counts, observable)]
    return (*rows, *(judge.grid(n, None) for n in grid_nodes))


def grid_row(
    solution: JointSolution,
    nodes: int,
    *,
    lsb_mm: float = 0.0,
    compensable: Mask | None = None,
    pairs: Pairs | None = None,
    sources: ErrorSources | None = None,
) -> Achievable:
    """Residual errors with a 3-D grid of ``nodes`` per axis; other parameters as `achievable`."""
    judge = _ResidualJudge(solution, pairs or random_pairs(inner_box_mm(solution.machine)), sources or error_sources(solution), lsb_mm)
    return judge.grid(nodes, compensable)


@dataclass(frozen=True, eq=False)
class _ResidualJudge:
    """Common basis for all kinds of table: pairs, sources of uncertainty, rounding."""

    solution: JointSolution
    pairs: Pairs
    sources: ErrorSources
    lsb_mm: float

    def row(self, kind: str, entries: int, stored: Correction | None = None, exact: Correction | None = None) -> Achievable:
        """Row of a kind of table from its correction as stored, and without rounding."""
        rounding = 0.0
        if stored is not None and exact is not None:
            added = correction_error_mm(stored, self.pairs) - correction_error_mm(exact, self.pairs)
            rounding = float(np.sqrt(np.mean(added**2)))
        return Achievable(kind, entries, predict_distances(self.solution, stored, pairs=self.pairs, sources=self.sources), rounding)

    def one_axis(self, counts: tuple[int, int, int]) -> list[Achievable]:
        """Positioning alone, with squareness, and all nine."""
        nine = nine_tables(self.solution, counts, sources=self.sources)
        square = squareness_tables(self.solution, counts, sources=self.sources)
        positioning = positioning_only(nine)
        stored = self._stored(positioning)
        return [
            self.row("positioning tables", sum(counts), stored.correction_at, positioning.correction_at),
            self.row(
                "positioning tables and squareness",
                sum(counts) + 3,
                lambda p: stored.correction_at(p) + square.squareness_at(p),
                lambda p: positioning.correction_at(p) + square.squareness_at(p),
            ),
            self.row("nine tables", 3 * sum(counts), self._stored(nine).correction_at, nine.correction_at),
        ]

    def single_motions(self, counts: tuple[int, int, int], observable: frozenset[str] | None) -> list[Achievable]:
        """Tables of motions under their own names."""
        observable_names = individually_observable(self.solution) if observable is None else observable
        out = []
        for kind, motions, any_tool in (
            ("tables of the motions that are observable by themselves", observable_names, True),
            ("tables of single motions, right for this tool only", enough_for_the_field(self.solution), False),
        ):
            if motions:
                tables = motion_tables(self.solution, counts, motions, any_tool=any_tool, sources=self.sources)
                out.append(self.row(kind, sum(v.size for v in tables.motions.values()) + 3, tables.correction_at))
        return out

    def grid(self, nodes: int, compensable: Mask | None) -> Achievable:
        """A grid of ``nodes`` per axis."""
        table = grid_table(self.solution, (nodes,) * 3, compensable=compensable, sources=self.sources)
        stored = quantise_grid(table, self.lsb_mm) if self.lsb_mm > 0 else table
        return self.row(f"grid {nodes} x {nodes} x {nodes}", 3 * nodes**3, stored.correction_at, table.correction_at)

    def _stored(self, tables: NineTables) -> NineTables:
        return quantise(tables, self.lsb_mm) if self.lsb_mm > 0 else tables
