"""The best sum of three functions, one of each axis, for a deviation field: over the volume and along its body diagonals.

The mean over the other two axes (the main effect) is the least-squares answer over the volume alone. The effect of angles at a distance
that depends on two axes at once remains, and much of it lies along the body diagonals, which ISO 230-6 tests. So the four diagonals
together weigh as much as the whole volume (tests/models/compensation/test_tables.py states gain and cost).

`mean_linear`: scale errors and squareness as the whole volume sees them, slopes of the main effects. The coefficients of the model are
stated at the carriages' pivots, where one tool length often cannot separate them from angles. Their mean effect over the volume - most of
what one-axis tables correct - is known far better, and is what people mean by "the" squareness.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy

from abbe.models.arrays import F1, F2, F3
from abbe.models.geometry.bases import Term, legendre_values
from abbe.models.geometry.chain import design
from abbe.models.geometry.volume import volume_grid
from abbe.models.machine import AXES, Machine
from abbe.models.paths import DIAGONALS, diagonal_ends
from abbe.models.solvers.joint import JointSolution
from abbe.models.solvers.priors import U_WAVELENGTH
from abbe.models.uncertainty.inputs import StatedInputs
from abbe.models.uncertainty.sources import ErrorSources, error_sources, variances

DIAGONAL_WEIGHT = 1.0
"""Weight of the four body diagonals together against that of the volume."""
DIAGONAL_POINTS = 33

Field = Callable[[F2], F3]
"""Values at positions, shape (n, 3) -> (n, 3 outputs, m): a design, or one field with m = 1."""


def additive_design(
    solution: JointSolution, grids_mm: tuple[F1, F1, F1], nodes: int, terms: tuple[Term, ...] | None = None
) -> tuple[F3, F3, F3]:
    """Design of the best additive field of a solution: per axis shape (len(grid), 3, terms), mm per unit of every coefficient.

    ``terms``: the solution's own, or with orders above them (`abbe.models.uncertainty.sources`); the fit is the same.
    """
    order = max(t.order for t in solution.terms) + 1  # an angle times a travel is of one order more along a diagonal than the angle
    field = _design_of(solution.machine, terms or solution.terms)
    return additive(field, solution.machine.stroke_mm, grids_mm, nodes=nodes, order=order)


def additive(field: Field, stroke_mm: F2, grids_mm: tuple[F1, F1, F1], *, nodes: int, order: int) -> tuple[F3, F3, F3]:
    """Best sum of three functions of one axis each, for the volume and its body diagonals, by least squares.

    Parameters
    ----------
    field : function
        Values at positions.
    stroke_mm : array, shape (3, 2)
    grids_mm : three arrays
        Positions of X, Y, Z at which the functions are wanted.
    nodes : int
        Nodes per axis of the volume.
    order : int
        Highest Legendre order of what the diagonals may add to the main effects.

    Returns
    -------
    three arrays, shape (len(grid), 3, m)
        In the unit of the field; constants are shared out arbitrarily between the axes.
    """
    beta = _towards_diagonals(field, stroke_mm, nodes, order)
    out = []
    for a in range(3):
        polynomials = legendre_values(grids_mm[a], stroke_mm[a], order)[:, 1:]
        out.append(_mean_over_others(field, stroke_mm, a, grids_mm[a], nodes) + np.einsum("nk,kim->nim", polynomials, beta[a]))
    return out[0], out[1], out[2]


def main_effect(machine: Machine, terms: tuple[Term, ...], axis: int, positions_mm: F1, nodes: int) -> F3:
    """Design of the mean deviation over the other two axes, shape (len(positions), 3, terms)."""
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
    """Additions to the main effects that serve the diagonals, as Legendre coefficients per axis, shape (3 axes, order, 3, m)."""
    volume = volume_grid(stroke_mm, max(nodes, order + 2))  # fewer nodes than polynomials would not hold them between the nodes
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
"""What every printed scale has to say: no material temperature correction is made."""

SQUARENESS_SLOPES = (("C0Y", 0, 1, -1.0), ("B0Z", 0, 2, 1.0), ("A0Z", 1, 2, -1.0))
"""Name, the two axes, and the sign that turns the sum of both slopes into it (docs/explanation/conventions.md)."""


@dataclass(frozen=True, slots=True)
class MeanParameter:
    """A linear parameter averaged over the volume: mm/mm for scales (EXX...), rad for squareness, with its standard uncertainty."""

    name: str
    value: float
    u: float


def mean_linear(solution: JointSolution, *, positions: int = 41, nodes: int = 9) -> tuple[MeanParameter, ...]:
    """Mean scale error of X, Y, Z (slope of EXX, EYY, EZZ) and mean squareness C0Y, B0Z, A0Z over the volume.

    Scales hold at the temperature the machine had while it was measured: nothing is reduced to 20 degree C, and 1 K of a steel machine is
    about 11 um/m; so the uncertainty of the scales' temperature is not in. All other sources are (`abbe.models.uncertainty.sources`),
    orders above the chosen one included. Least-squares slopes over equidistant positions. The laser's wavelength is an unknown of every
    solution with a laser (`laser_scale`) and so within its sources; without one, scales carry its uncertainty all the same: none is known
    better.
    """
    sources = error_sources(solution, replace(StatedInputs().as_measured(), u_wavelength=0.0))  # the wavelength is in ``common``
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
    """Parameter that is ``gradient @ coefficients``, with its uncertainty from all sources and ``u_common`` on top."""
    u = float(np.sqrt(variances(sources, gradient[None])[0]))
    return MeanParameter(name, float(gradient @ sources.coefficients), float(np.hypot(u, u_common)))
