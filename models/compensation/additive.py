"""The best sum of three functions, one of each axis, for a deviation field: over the volume and along its body diagonals.

The mean over the other two axes (the main effect) is the least-squares answer over the volume alone. The effect of angles at a distance
that depends on two axes at once remains, and much of it lies along the body diagonals, which ISO 230-6 tests. So the four diagonals
together weigh as much as the whole volume (tests/models/compensation/test_tables.py states gain and cost).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.geometry.bases import Term, legendre_values
from abbe.models.geometry.chain import design
from abbe.models.geometry.volume import volume_grid
from abbe.models.machine import Machine
from abbe.models.paths.lines import DIAGONALS, diagonal_ends
from abbe.models.solvers.joint import JointSolution

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
    """What has to be added to the main effects, in Legendre polynomials of each axis: shape (3 axes, order, 3, m)."""
    volume = volume_grid(stroke_mm, max(nodes, order + 2))  # fewer nodes than polynomials would not hold them between the nodes
    lines = np.concatenate([np.linspace(*diagonal_ends(stroke_mm, d), DIAGONAL_POINTS) for d in DIAGONALS])
    points = np.concatenate([volume, lines])
    weight = np.sqrt(np.r_[np.full(len(volume), 1.0 / len(volume)), np.full(len(lines), DIAGONAL_WEIGHT / len(lines))])
    left = field(points)
    columns = [np.ones((len(points), 1))]
    for a in range(3):
        where, back = np.unique(points[:, a], return_inverse=True)
        left = left - _mean_over_others(field, stroke_mm, a, where, nodes)[back]
        columns.append(legendre_values(points[:, a], stroke_mm[a], order)[:, 1:])
    basis: F2 = np.concatenate(columns, axis=1)
    beta = np.linalg.lstsq(basis * weight[:, None], (left * weight[:, None, None]).reshape(len(points), -1), rcond=None)[0]
    return np.asarray(beta[1:].reshape(3, order, 3, -1))


def _cell_centres(stroke_mm: F1, nodes: int) -> F1:
    step = (stroke_mm[1] - stroke_mm[0]) / nodes
    return np.asarray(stroke_mm[0] + step * (np.arange(nodes) + 0.5))
