"""Tables of single error motions, for controls that store up to 21 of them and compute the deviation by their own kinematic model.

One campaign with one tool does not determine every single motion: turning and shifting a carriage look alike at one tool length (math.md
4.6). A motion that the data do not separate from others is not written under its name. The caller chooses by naming the motions:

- only motions that are observable by themselves (`observable_alone`, the default): valid for every tool, but motions that are known only
  together with a hidden one, or are mostly an assumption, stay uncorrected;
- `enough_for_the_field`: as few motions as carry the whole deviation; the others are zero. Valid at this tool length only, and so labelled.

In the first case every motion has its own estimate; in the second the written motions also carry the effect of the others at this tool.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from abbe.models.arrays import F1, F2
from abbe.models.compensation.tables import grid_positions
from abbe.models.functions.motions import PLACES, SQUARENESS
from abbe.models.geometry.bases import term_values
from abbe.models.geometry.chain import design, deviation_mm, squareness_motions
from abbe.models.geometry.volume import rigid_design, volume_grid
from abbe.models.machine import Machine
from abbe.models.solvers.assessment import motions_of
from abbe.models.solvers.joint import JointSolution
from abbe.models.solvers.observability.parameters import observable_motions
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
        A name that is no motion of the solution, no name at all, or (``any_tool``) a motion that the data do not separate from others.
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
    seen = observable_alone(solution) if motions is None or any_tool else frozenset(known)
    wanted = seen if motions is None else frozenset(motions)
    if not wanted or not wanted <= known:
        raise ValueError(f"motion tables: {', '.join(sorted(wanted - known)) or 'no motion'} cannot be written")
    if not wanted <= seen:
        raise ValueError(
            f"motion tables: {', '.join(sorted(wanted - seen))} cannot be written under their own names: the readings do not "
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


def observable_alone(solution: JointSolution, *, weak: bool = False) -> frozenset[str]:
    """Motions that the report on this solution calls observed (with ``weak``: or weak), by the same rule (`observable_motions`).

    None of their coefficients is in a hidden combination, and the readings carry at least 90 % (10 %) of their information.
    """
    return frozenset(observable_motions(motions_of(solution), weak=weak))


def enough_for_the_field(solution: JointSolution) -> frozenset[str]:
    """Motions that carry the deviation with the machine's own tool when all others are zero; angles are given up first."""
    field = _field(solution)
    triangle = linalg.qr(field / np.maximum(np.linalg.norm(field, axis=0), 1e-300), mode="r")[0][: field.shape[1]]
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
