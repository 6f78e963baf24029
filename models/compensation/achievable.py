"""Achievable accuracy of each kind of compensation table on this machine: residual errors of distances with their uncertainty.

All kinds of table correct the same identified deviation; its unknown part (`PredictedDistances.unknown_mm`) remains with each kind.
Errors are computed to first order over the inner 80 % of the strokes.

This module also makes tables of single error motions, for controls that store up to 21 of them and compute the deviation by their own
kinematic model. One campaign with one tool does not determine every motion: at one tool length, turning and shifting a carriage look alike.
The caller names the motions to write:

- `individually_observable` (default): only motions that the data separate from all others. The tables hold for every tool, but the other
  motions stay uncorrected.
- `enough_for_the_field`: as few motions as reproduce the whole deviation; they also carry the effect of the others. The tables hold
  at this tool length only, and are labelled so.
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
from abbe.models.compensation.nine_tables import entry_u, nine_tables, table_design
from abbe.models.compensation.tables import NineTables, grid_positions, quantise
from abbe.models.functions.motions import PLACES, SQUARENESS
from abbe.models.geometry.bases import SMOOTH_ORDER, term_values
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
"""Weight of a motion's own estimate against the deviation; it decides only combinations that the deviation leaves open."""


@dataclass(frozen=True, eq=False)
class MotionTables:
    """Tables of error motions over their own axis; the control changes the sign to correct them.

    Attributes
    ----------
    machine : Machine
        Nominal machine, with the tool for which the tables hold.
    position_mm : three arrays
        Grid of X, Y, Z.
    motions, u : dict
        ``"EXX"`` ..: values at the grid of the moving axis, mm or rad, and their standard uncertainty. Missing motions are zero.
    squareness_rad, u_squareness_rad : dict
        ``"C0Y"`` ..; travel is measured from the start of the stroke.
    left_out : tuple of str
        Motions not in the tables: not observable by themselves, or not named by the caller.
    any_tool : bool
        Whether the tables hold for any tool, because every motion in them is observable by itself.
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
        """Return the corrections of a control at commanded positions, mm, shape (n, 3): linear between nodes, with the levers of rule G."""
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
    """Make tables of the named motions; ``left_out`` of the result lists the others.

    Parameters
    ----------
    counts : (int, int, int)
        Grid points of X, Y, Z.
    motions : set of str, optional
        Motions to write: ``"EXX"`` .. ``"ECZ"``, ``"C0Y"``, ``"B0Z"``, ``"A0Z"``. Default: `individually_observable`.
    any_tool : bool
        True: each motion gets its own estimate and must be observable by itself. False, for `enough_for_the_field`: the motions get values
        that best reproduce the identified deviation with the machine's own tool while all others are zero.
    sources : ErrorSources, optional
        Sources of uncertainty; default: ``error_sources(solution)``, with the documented inputs.

    Raises
    ------
    ValueError
        A name is missing or not a motion of the solution, or (``any_tool``) the data do not separate a motion from others.
    """
    known = {t.motion for t in solution.terms}
    motions = _writable(solution, known, motions, any_tool)
    sources = sources or error_sources(solution)
    grids = grid_positions(solution.machine, counts)
    keep = [i for i, t in enumerate(sources.terms) if t.motion in motions]  # the solution's own, then higher orders without a value
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
    """Return the motions to write; ValueError if one of the named motions may not be written."""
    observable_names = individually_observable(solution) if motions is None or any_tool else frozenset(known)
    wanted = observable_names if motions is None else frozenset(motions)
    if not wanted or not wanted <= known:
        raise ValueError(
            f"motion tables: {', '.join(sorted(wanted - known)) or 'no motion'} cannot be written; the solution has "
            f"{', '.join(sorted(known))}"
        )
    if not wanted <= observable_names:
        raise ValueError(
            f"motion tables: the readings do not separate {', '.join(sorted(wanted - observable_names))} from other motions. "
            "Measure with a second tool length, or make tables for this tool only (any_tool=False)"
        )
    return wanted


def _entries(sources: ErrorSources, name: str, grids: tuple[F1, F1, F1], keep: list[int], operator: F2) -> tuple[F1, F1]:
    """Return values and standard uncertainties of a motion on the grid of its axis; for a squareness, one value in rad."""
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
    """Return the motions that the report calls observed; with ``weak``, also the weakly observed motions.

    No coefficient of these motions is part of a hidden combination, and the readings carry at least 90 % (weak: 10 %) of the information.
    """
    return frozenset(observable_motions(motions_of(solution), weak=weak))


def enough_for_the_field(solution: JointSolution) -> frozenset[str]:
    """Return a minimal set of motions that reproduces the deviation with the machine's own tool; angles are dropped first."""
    smooth, field = _field(solution)
    triangle = scipy.linalg.qr(field / np.maximum(np.linalg.norm(field, axis=0), 1e-300), mode="r")[0][: field.shape[1]]
    names = [*[solution.terms[i].motion for i in smooth], *["rigid"] * 6]

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


def _field(solution: JointSolution) -> tuple[list[int], F2]:
    """Return the indices of the q smooth coefficients, and the deviation over the volume per unit of each, then of each of 6 rigid motions.

    The deviation has shape (3 x points, q + 6). Terms above `SMOOTH_ORDER` are left out, because no angle has the effect of such a term.
    """
    smooth = [i for i, t in enumerate(solution.terms) if t.order <= SMOOTH_ORDER]
    terms = tuple(solution.terms[i] for i in smooth)
    grid = volume_grid(solution.machine.stroke_mm, max(NODES, max(t.order for t in terms) + 2))
    full = design(solution.machine, terms, grid).reshape(3 * len(grid), -1)
    return smooth, np.concatenate([full, rigid_design(grid).reshape(-1, 6)], axis=1)


def _refit(solution: JointSolution, keep: list[int]) -> F2:
    """Return the coefficients of the kept terms that best reproduce the deviation of each single coefficient, shape (kept, terms)."""
    smooth, field = _field(solution)
    n = len(smooth)
    kept = [k for k, i in enumerate(keep) if i in set(smooth)]
    own = [smooth.index(keep[k]) for k in kept]
    weight = TOWARDS_ESTIMATE * np.sqrt(len(field))
    near = np.zeros((len(own), n))
    near[np.arange(len(own)), own] = weight * np.linalg.norm(field[:, own], axis=0) / np.sqrt(len(field))
    a = np.concatenate([field[:, own], field[:, n:]], axis=1)
    ridge = np.concatenate([near[:, own], np.zeros((len(own), 6))], axis=1)
    out = np.eye(len(solution.terms))[keep]
    out[np.ix_(kept, smooth)] = np.linalg.lstsq(np.concatenate([a, ridge]), np.concatenate([field[:, :n], near]), rcond=None)[0][: len(own)]
    return out


# Tables for controls that take fewer than nine: positioning tables, cross tables beside them, squareness as parameters.
#
# No error is corrected twice, and all parts together correct as much as the nine tables. Only a rotation of the frame is lost, which
# squareness parameters cannot express and which changes no distance.


def positioning_only(tables: NineTables) -> NineTables:
    """Return the nine tables with only the three own-axis tables kept (pitch error compensation); the six cross tables are zero."""
    return _kept(tables, lambda a: np.arange(3) == a)


def cross_only(tables: NineTables) -> NineTables:
    """Return the nine tables with only the six cross tables kept; with `positioning_only` they give all nine again."""
    return _kept(tables, lambda a: np.arange(3) != a)


@dataclass(frozen=True, eq=False)
class SquarenessTables:
    """Squareness as three ``parameters`` (C0Y, B0Z, A0Z, rad, with u), and ``tables`` without squareness.

    The parameters come from the nine tables, which weigh the body diagonals as much as the volume. They can differ from the mean squareness
    over the volume (`abbe.models.compensation.additive.mean_linear`) by more than its uncertainty.

    ``tables``: the own-axis tables of the nine, and cross tables without slope, i.e. pure straightness. The rest of their
    slopes is a rotation of the frame and is left out. ``start_mm``: axis positions at which the parameters correct nothing.
    """

    parameters: tuple[MeanParameter, ...]
    tables: NineTables
    start_mm: F1

    def squareness_at(self, axes_mm: F2) -> F2:
        """Return the correction by the parameters alone, mm, shape (n, 3): +C0Y y to X, −B0Z z to X, +A0Z z to Y, from ``start_mm`` on."""
        out = np.zeros((axes_mm.shape[0], 3))
        for parameter, (_, first, second, sign) in zip(self.parameters, SQUARENESS_SLOPES, strict=True):
            out[:, first] -= sign * parameter.value * (axes_mm[:, second] - self.start_mm[second])
        return out

    def correction_at(self, axes_mm: F2) -> F2:
        """Return the correction by parameters and tables together, mm, shape (n, 3)."""
        return self.squareness_at(axes_mm) + self.tables.correction_at(axes_mm)


def squareness_tables(
    solution: JointSolution, counts: tuple[int, int, int], *, nodes: int = 9, sources: ErrorSources | None = None
) -> SquarenessTables:
    """Split the nine tables into squareness parameters and tables without squareness; arguments as in `nine_tables`.

    The squareness parameters and their uncertainties are those of the least-squares slopes of the tables.
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
    """Accuracy that one kind of table can achieve.

    Attributes
    ----------
    kind : str
        Name shown to the user.
    entries : int
        Number of values that the controller stores.
    distances : PredictedDistances
        Residual errors with the table as stored, rounding included.
    rounding_mm : float
        Rms of the distance errors that come from rounding to the controller's unit alone; 0 without a unit.
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
    """Predict the accuracy of every kind of table on this machine, from no table to the finest grid.

    Parameters
    ----------
    counts : (int, int, int)
        Points of one-axis tables on X, Y, Z.
    grid_nodes : tuple of int
        Nodes per axis of the 3-D grids.
    lsb_mm : float
        The controller's unit, mm; 0: no rounding. Tables of single motions and squareness parameters are not rounded.
    observable : set of str, optional
        Motions that are observable by themselves; default: `individually_observable`.
    sources : ErrorSources, optional
        Sources of uncertainty; default: ``error_sources(solution)``, with the documented inputs.
    """
    judge = _ResidualJudge(solution, random_pairs(inner_box_mm(solution.machine)), sources or error_sources(solution), lsb_mm)
    rows = [judge.row("no table", 0), *judge.one_axis(counts), *judge.single_motions(counts, observable)]
    return (*rows, *(judge.grid(n, None) for n in grid_nodes))


@dataclass(frozen=True, eq=False)
class _ResidualJudge:
    """Judges all kinds of table by the same pairs, sources of uncertainty and unit."""

    solution: JointSolution
    pairs: Pairs
    sources: ErrorSources
    lsb_mm: float

    def row(self, kind: str, entries: int, stored: Correction | None = None, exact: Correction | None = None) -> Achievable:
        """Judge a kind of table by its correction as ``stored``; ``exact``: the correction without rounding."""
        rounding = 0.0
        if stored is not None and exact is not None:
            added = correction_error_mm(stored, self.pairs) - correction_error_mm(exact, self.pairs)
            rounding = float(np.sqrt(np.mean(added**2)))
        return Achievable(kind, entries, predict_distances(self.solution, stored, pairs=self.pairs, sources=self.sources), rounding)

    def one_axis(self, counts: tuple[int, int, int]) -> list[Achievable]:
        """Judge positioning tables alone, positioning tables with squareness parameters, and all nine tables."""
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
        """Judge tables of the motions that are observable by themselves, and of the fewest motions that reproduce the deviation with this
        tool.
        """
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
        """Judge a 3-D grid of ``nodes`` per axis."""
        table = grid_table(self.solution, (nodes,) * 3, compensable=compensable, sources=self.sources)
        stored = quantise_grid(table, self.lsb_mm) if self.lsb_mm > 0 else table
        return self.row(f"grid {nodes} x {nodes} x {nodes}", 3 * nodes**3, stored.correction_at, table.correction_at)

    def _stored(self, tables: NineTables) -> NineTables:
        return quantise(tables, self.lsb_mm) if self.lsb_mm > 0 else tables
