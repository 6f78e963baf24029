"""Step diagonals and single-axis laser lines on Wang's machine FXYZ as least-squares problems, for ranks and a demonstration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.functions.monomials import monomials
from abbe.models.papers.wang.model import diagonal_beam, mirror_normal, monomial_field, step_readings_mm, tilt_axes
from abbe.models.paths import DIAGONALS, diagonal_ends, step_diagonal, straight_line
from abbe.models.solvers.designs import Field, laser_rows, stacked

Deviation = Callable[[F2], F2]
"""Maps commanded positions (n, 3), mm, to the machine's deviation (n, 3), mm."""


@dataclass(frozen=True)
class WangPlan:
    """A plan of laser measurements.

    Attributes
    ----------
    travel_mm : array, shape (3,)
        Travels X, Y, Z; each starts at 0.
    steps : int
        Steps per axis of a diagonal.
    positions : int
        Positions of a single-axis line, both ends included.
    orders : tuple of str
        Step orders; the four diagonals are run once in each.
    tilts : bool
        Whether the mirror of each diagonal is tilted by two unknown angles; otherwise it is ideal.
    axes : str
        Axes also measured by single-axis lines, e.g. ``"XY"``.
    edges : tuple of int
        Positions of these lines: 0 with the other axes at 0, 1 with the other axes at their far end.
    """

    travel_mm: F1
    steps: int
    positions: int
    orders: tuple[str, ...] = ("XYZ",)
    tilts: bool = True
    axes: str = ""
    edges: tuple[int, ...] = (0,)

    @property
    def diagonals(self) -> list[tuple[str, F2]]:
        """Name and path (3 steps + 1, 3) of every diagonal run."""
        box = np.stack([np.zeros(3), self.travel_mm], axis=1)
        return [(d, step_diagonal(*diagonal_ends(box, d), self.steps, order, back=False)) for order in self.orders for d in DIAGONALS]

    @property
    def lines(self) -> list[tuple[int, F2]]:
        """Axis and path (positions, 3) of every single-axis line."""
        out = []
        for edge in self.edges:
            for letter in self.axes:
                axis = "XYZ".index(letter)
                start = self.travel_mm * float(edge)
                end = start.copy()
                start[axis], end[axis] = 0.0, self.travel_mm[axis]
                out.append((axis, straight_line(start, end, self.positions, back=False)))
        return out


def problem(plan: WangPlan, degree: int) -> tuple[F2, F2]:
    """Return the design matrices of the error functions (18 degree - 3 columns) and of the mirror tilts.

    The first reading of each run is always zero and has no row.
    """
    terms = monomials(degree)

    def field(points_mm: F2) -> F3:
        return monomial_field(terms, points_mm, plan.travel_mm)

    return _design(plan, field)


def _design(plan: WangPlan, field: Field) -> tuple[F2, F2]:
    parts, setups, per = [], [], 2 if plan.tilts else 0
    for k, (name, path) in enumerate(plan.diagonals):
        beam = diagonal_beam(plan.travel_mm, name)
        rows = laser_rows(field, path, beam, tilt_axes(beam))
        parts.append(rows.machine)
        setups.append((rows.setup[:, :per], tuple(range(per * k, per * k + per))))
    for axis, path in plan.lines:
        rows = laser_rows(field, path, np.eye(3)[axis], np.zeros((0, 3)))
        parts.append(rows.machine)
        setups.append((rows.setup, ()))
    return stacked(parts, setups)


def readings(plan: WangPlan, deviation: Deviation, tilt_rad: dict[str, F1]) -> F1:
    """Return the laser readings on a machine, in the order of the rows of `problem`, mm.

    Parameters
    ----------
    deviation : callable
        Commanded positions to deviation, mm.
    tilt_rad : dict of arrays (2,)
        Mirror tilts of each diagonal, rad; a missing diagonal has an ideal mirror.
    """
    out = []
    for name, path in plan.diagonals:
        beam = diagonal_beam(plan.travel_mm, name)
        mirror = mirror_normal(beam, tilt_rad.get(name, np.zeros(2)))
        out.append(step_readings_mm(path, deviation(path), beam, mirror)[1:])
    for axis, path in plan.lines:
        along = deviation(path)[:, axis]
        out.append(along[1:] - along[0])
    return np.concatenate(out)


def distance_errors_mm(points_mm: F2, model_mm: F2, machine_mm: F2) -> F1:
    """Return the distances between all pairs of points by a model minus those of the machine, shape (n (n - 1) / 2,), mm.

    Distances do not depend on the frame, so volumetric maps can be compared without removal of a rigid motion.

    Parameters
    ----------
    points_mm, model_mm, machine_mm : array, shape (n, 3)
        Nominal points, and the deviations of model and machine there.
    """
    i, j = np.triu_indices(len(points_mm), 1)
    d, a, b = (v[i] - v[j] for v in (points_mm, model_mm, machine_mm))
    off = np.einsum("ni,ni->n", a - b, 2.0 * d + a + b)
    return np.asarray(off / (np.linalg.norm(d + a, axis=1) + np.linalg.norm(d + b, axis=1)))


def interpolated_mm(points_mm: F2, inc_mm: F1, e_mm: F3) -> F2:
    """Return the deviation map of nine displacement curves, eq (10): the sum over the axes, linear between the steps.

    Beyond the last step the last value holds. Such a map has no lever arms and so no angular errors.

    Parameters
    ----------
    points_mm : array, shape (n, 3)
        Positions from the start of the diagonals' box.
    inc_mm : array, shape (3,)
        Increments X, Y, Z.
    e_mm : array, shape (3, 3, m + 1)
        E[i, a, k] in direction i after k steps of axis a (`abbe.models.solvers.step_diagonal.wang_eq7`).

    Returns
    -------
    array, shape (n, 3), mm, actual minus nominal, machine coordinates.
    """
    out = np.zeros_like(points_mm)
    for a in range(3):
        at = np.arange(e_mm.shape[2]) * inc_mm[a]
        for i in range(3):
            out[:, i] += np.interp(points_mm[:, a], at, e_mm[i, a])
    return out
