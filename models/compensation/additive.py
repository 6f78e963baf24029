"""Best approximation of a deviation field by a sum of three functions, one of each axis.

Over the volume alone, the least-squares solution is the mean over the other two axes (the main effect). The effect of angles at a lever
that depends on two axes remains, and much of it lies along the body diagonals, which ISO 230-6 tests. So the four diagonals together weigh
as much as the whole volume (tests/models/compensation/test_tables.py states gain and cost).

`mean_linear` returns scale errors and squareness as slopes of the main effects. The coefficients of the model hold at the pivots of the
carriages, where one tool length often cannot separate them from angles. Their mean effect over the volume has a far smaller uncertainty,
and is usually meant by "the squareness" of a machine.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy

from abbe.models.arrays import F1, F2, F3
from abbe.models.geometry.bases import Term, legendre_values
from abbe.models.geometry.chain import design
from abbe.models.geometry.volume import volume_grid
from abbe.models.machine import AXES, Machine
from abbe.models.paths import DIAGONALS, diagonal_ends

if TYPE_CHECKING:
    from abbe.models.solvers.joint import JointSolution
    from abbe.models.uncertainty.sources import ErrorSources

DIAGONAL_WEIGHT = 1.0
"""Weight of the four body diagonals together; the volume has weight 1."""
DIAGONAL_POINTS = 33

Field = Callable[[F2], F3]
"""Function of positions (n, 3) that returns the deviation per unit of m coefficients, or one field (m = 1), shape (n, 3 directions, m)."""


def additive_design(
    solution: JointSolution, grids_mm: tuple[F1, F1, F1], nodes: int, terms: tuple[Term, ...] | None = None
) -> tuple[F3, F3, F3]:
    """Return, for one unit of every coefficient, the additive field that fits its deviation best: per axis, shape (len(grid), 3, terms).

    ``terms``: by default those of the solution; may include higher orders (`abbe.models.uncertainty.sources`).
    """
    order = diagonal_order(solution.terms)
    field = _design_of(solution.machine, terms or solution.terms)
    return additive(field, solution.machine.stroke_mm, grids_mm, nodes=nodes, order=order)


def diagonal_order(terms: tuple[Term, ...]) -> int:
    """Return the highest Legendre order of a deviation along the diagonals without its main effects.

    Only angles remain, because the deviation by a translational motion is a function of one axis. Along a diagonal, an angle
    times a travel is one order higher than the angle.
    """
    return max((t.order for t in terms if t.component > 2), default=0) + 1


def additive(field: Field, stroke_mm: F2, grids_mm: tuple[F1, F1, F1], *, nodes: int, order: int) -> tuple[F3, F3, F3]:
    """Fit a sum of three functions of one axis each to a field, over the volume and its body diagonals, by least squares.

    Parameters
    ----------
    field : function
        Values at positions (`Field`).
    stroke_mm : array, shape (3, 2)
    grids_mm : three arrays
        Positions of X, Y, Z at which to return the functions.
    nodes : int
        Nodes per axis of the volume.
    order : int
        Highest Legendre order of the functions that are added to the main effects to fit the diagonals too.

    Returns
    -------
    three arrays, shape (len(grid), 3, m)
        In the unit of the field. The split of constants between the axes is arbitrary.
    """
    beta = _towards_diagonals(field, stroke_mm, nodes, order)
    out = []
    for a in range(3):
        polynomials = legendre_values(grids_mm[a], stroke_mm[a], order)[:, 1:]
        out.append(_mean_over_others(field, stroke_mm, a, grids_mm[a], nodes) + np.einsum("nk,kim->nim", polynomials, beta[a]))
    return out[0], out[1], out[2]


def main_effect(machine: Machine, terms: tuple[Term, ...], axis: int, positions_mm: F1, nodes: int) -> F3:
    """Return the mean deviation over the other two axes per unit of every coefficient, shape (len(positions), 3, terms)."""
    return _mean_over_others(_design_of(machine, terms), machine.stroke_mm, axis, positions_mm, nodes)


def _design_of(machine: Machine, terms: tuple[Term, ...]) -> Field:
    return lambda points: design(machine, terms, points)


def _mean_over_others(field: Field, stroke_mm: F2, axis: int, positions_mm: F1, nodes: int) -> F3:
    others = [b for b in range(3) if b != axis]
    plane = np.stack(np.meshgrid(*[_cell_centres(stroke_mm[b], nodes) for b in others], indexing="ij"), axis=-1).reshape(-1, 2)
    points = np.empty((positions_mm.size, plane.shape[0], 3))
    points[:, :, axis] = positions_mm[:, None]
    points[:, :, others] = plane[None]
    full = field(points.reshape(-1, 3))
    return np.asarray(full.reshape(positions_mm.size, plane.shape[0], 3, -1).mean(axis=1))


def _towards_diagonals(field: Field, stroke_mm: F2, nodes: int, order: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Return the functions added to the main effects to fit the diagonals too: Legendre coefficients, shape (3 axes, order, 3, m)."""
    volume = volume_grid(stroke_mm, max(nodes, order + 2))  # fewer nodes would not determine the polynomials
    lines = np.concatenate([np.linspace(*diagonal_ends(stroke_mm, d), DIAGONAL_POINTS) for d in DIAGONALS])
    points = np.concatenate([volume, lines])
    weight = np.sqrt(np.r_[np.full(len(volume), 1.0 / len(volume)), np.full(len(lines), DIAGONAL_WEIGHT / len(lines))])
    left = field(points)
    columns = [np.ones((len(points), 1))]
    for a in range(3):
        coordinates, back = np.unique(points[:, a], return_inverse=True)
        left = left - _mean_over_others(field, stroke_mm, a, coordinates, nodes)[back]
        columns.append(legendre_values(points[:, a], stroke_mm[a], order)[:, 1:])
    basis: F2 = np.concatenate(columns, axis=1)
    q, r = np.linalg.qr(basis * weight[:, None])
    beta = scipy.linalg.solve_triangular(r, (q * weight[:, None]).T @ left.reshape(len(points), -1))
    return np.asarray(beta[1:].reshape(3, order, 3, -1))


def _cell_centres(stroke_mm: F1, nodes: int) -> F1:
    step = (stroke_mm[1] - stroke_mm[0]) / nodes
    return np.asarray(stroke_mm[0] + step * (np.arange(nodes) + 0.5))


SCALE_NOTE = "at the machine's temperature while it was measured"
"""Note beside every printed scale error: Abbe does not correct it to 20 degree C."""

SQUARENESS_SLOPES = (("C0Y", 0, 1, -1.0), ("B0Z", 0, 2, 1.0), ("A0Z", 1, 2, -1.0))
"""Squareness, its two axes, and the sign by which the sum of their slopes gives it (docs/explanation/conventions.md)."""


@dataclass(frozen=True, slots=True)
class MeanParameter:
    """A scale error (EXX..., mm/mm) or squareness (rad) averaged over the volume, with its standard uncertainty."""

    name: str
    value: float
    u: float


def mean_linear(solution: JointSolution, *, positions: int = 41, nodes: int = 9) -> tuple[MeanParameter, ...]:
    """Return the mean scale errors of X, Y, Z (slopes of EXX, EYY, EZZ) and the mean squareness C0Y, B0Z, A0Z over the volume.

    These are least-squares slopes over equidistant positions. Scale errors hold at the temperature of the machine during the measurement,
    without correction to 20 degree C (1 K of a steel machine is about 11 um/m). Their uncertainty therefore excludes the temperature of the
    scales and includes all other sources (`abbe.models.uncertainty.sources`). One of these is the laser's wavelength: an unknown
    (`laser_scale`) if a laser was used, otherwise an assumed uncertainty of the reference length.
    """
    from abbe.models.solvers.priors import U_WAVELENGTH
    from abbe.models.uncertainty.inputs import StatedInputs
    from abbe.models.uncertainty.sources import error_sources

    sources = error_sources(solution, replace(StatedInputs().as_measured(), u_wavelength=0.0))  # ``common`` holds the wavelength
    slopes = {}
    for a in range(3):
        first, last = (float(v) for v in solution.machine.stroke_mm[a])
        p = np.linspace(first, last, positions)
        weight = (p - p.mean()) / np.sum((p - p.mean()) ** 2)
        slopes[a] = np.einsum("p,pik->ik", weight, main_effect(solution.machine, sources.terms, a, p, nodes))
    common = 0.0 if "laser_scale" in solution.setup.names else U_WAVELENGTH
    found = [mean_parameter(sources, f"E{AXES[a]}{AXES[a]}", slopes[a][a], common) for a in range(3)]
    found += [mean_parameter(sources, name, sign * (slopes[a][b] + slopes[b][a])) for name, a, b, sign in SQUARENESS_SLOPES]
    return tuple(found)


def mean_parameter(sources: ErrorSources, name: str, gradient: F1, u_common: float = 0.0) -> MeanParameter:
    """Return the parameter ``gradient @ coefficients`` with its uncertainty from all sources and from ``u_common``, in quadrature."""
    from abbe.models.uncertainty.sources import variances

    u = float(np.sqrt(variances(sources, gradient[None])[0]))
    return MeanParameter(name, float(gradient @ sources.coefficients), float(np.hypot(u, u_common)))
