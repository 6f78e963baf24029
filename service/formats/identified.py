"""An identified machine, and the decomposition of its errors into the tables that controls can hold.

Rule G (docs/explanation/conventions.md): a carriage's angle times the travel of ANOTHER axis is a product of two functions of one axis
each; everything else of a first-order machine is a sum of functions of one axis. So one-axis tables, cross tables and products suffice.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.compensation.additive import additive, diagonal_order
from abbe.models.compensation.grid import FIT_SAMPLES, cells, nodes_mm
from abbe.models.functions.legendre import legendre_values
from abbe.models.functions.motions import PLACES, SQUARENESS
from abbe.models.geometry.bases import Term, term_values
from abbe.models.geometry.chain import design
from abbe.models.machine import AXES, Machine, lever_masks
from abbe.service.formats.model import AxisCurve, AxisTable, Lattice, Motions, ProductTable

Grids = tuple[F1, F1, F1]
NODES = 9
BEND_WEIGHT = 1e-3
SPACING_DECIMALS = 4
"""Decimals of the pitch of every grid, mm: 0.1 µm is the coarsest resolution of positions among the formats."""


@dataclass(frozen=True, eq=False)
class Identified:
    """The identified errors of a machine: coefficients of error-motion terms (mm, rad), and the lost motion B of each axis, mm.

    The deviation while moving in direction s is design @ coefficients − s B/2.
    """

    machine: Machine
    terms: tuple[Term, ...]
    coefficients: F1
    lost_motion_mm: Mapping[str, float] = field(default_factory=dict)

    def deviation_mm(self, axes_mm: F2) -> F2:
        """Return the mean deviation of both directions, mm, shape (n, 3)."""
        return np.asarray(design(self.machine, self.terms, axes_mm) @ self.coefficients)

    def moving_mm(self, axes_mm: F2, direction: int) -> F2:
        """Return the deviation while all axes move in + (1) or in − (−1), mm, shape (n, 3)."""
        lost = np.array([self.lost_motion_mm.get(a, 0.0) for a in AXES])
        return self.deviation_mm(axes_mm) - 0.5 * direction * lost

    def motion(self, name: str, position_mm: F1) -> F1:
        """Return one of the 18 error motions (without squareness) at positions of its axis, mm or rad."""
        axis = PLACES[name][0]
        mine = [i for i, t in enumerate(self.terms) if t.motion == name]
        points = np.tile(self.machine.centre_mm, (position_mm.size, 1))
        points[:, axis] = position_mm
        chosen = tuple(self.terms[i] for i in mine)
        return np.asarray(term_values(chosen, points, self.machine.stroke_mm) @ self.coefficients[mine])


def grid_mm(machine: Machine, axis: int, points: int, reference_mm: F1) -> F1:
    """Return equidistant points that cover the stroke and include the reference, as incremental formats need, mm."""
    low, high = machine.stroke_mm[axis]
    reference = float(np.clip(reference_mm[axis], low, high))
    pitch = np.ceil((high - low) / max(1, points - 2) * 10**SPACING_DECIMALS - 1e-6) / 10**SPACING_DECIMALS
    if abs(reference - low) < 1e-9 or abs(reference - high) < 1e-9:
        pitch = np.ceil((high - low) / (points - 1) * 10**SPACING_DECIMALS - 1e-6) / 10**SPACING_DECIMALS
    before, after = (int(np.ceil(v / pitch - 1e-9)) for v in (reference - low, high - reference))
    return np.asarray(np.round(reference + pitch * np.arange(-before, after + 1), SPACING_DECIMALS))


def line_fit(grid: F1, stroke_mm: F1) -> tuple[F1, F2]:
    """Return sampling positions inside the stroke, and the matrix that turns values there into the nodes of the best piecewise linear fit.

    A grid may reach beyond the stroke by part of a cell; a weak penalty on bends extrapolates the function there.
    """
    low, high = stroke_mm
    inside = np.clip(grid, low, high)
    cells_ = np.flatnonzero(np.diff(inside) > 0)
    part = (np.arange(FIT_SAMPLES) + 0.5) / FIT_SAMPLES
    at = (inside[cells_, None] + np.diff(inside)[cells_, None] * part).ravel()
    index, share = cells(grid, at)
    hat = np.zeros((at.size, grid.size))
    hat[np.arange(at.size), index], hat[np.arange(at.size), index + 1] = 1.0 - share, share
    weight = np.sqrt(np.repeat(np.diff(inside)[cells_] / np.diff(grid)[cells_], FIT_SAMPLES))
    bend = BEND_WEIGHT * np.diff(np.eye(grid.size), 2, axis=0)
    solve = np.linalg.pinv(np.concatenate([hat * weight[:, None], bend]))
    return at, np.asarray(solve[:, : at.size] * weight)


def products_of(known: Identified, grids: Grids, reference_mm: F1) -> tuple[ProductTable, ...]:
    """Return all products of rule G as corrections: minus an angle over its axis, times the travel of another axis from the reference."""
    masks, unit = lever_masks(known.machine.chain), np.eye(3)
    out = []
    for j, k, c in product(range(3), range(3), range(3)):
        name = f"E{'ABC'[c]}{AXES[j]}"
        effect = np.cross(unit[c], unit[k])
        if j == k or masks[j, k] == 0.0 or not effect.any() or not any(t.motion == name for t in known.terms):
            continue
        output = int(np.flatnonzero(effect)[0])
        angle = AxisCurve(AXES[j], grids[j], -effect[output] * _sampled(known, name, grids[j]))
        out.append(ProductTable(AXES[output], angle, AxisCurve(AXES[k], grids[k], grids[k] - reference_mm[k])))
    return tuple(out)


def _sampled(known: Identified, name: str, grid: F1) -> F1:
    """Fit a motion by the best piecewise linear function on a grid."""
    at, operator = line_fit(grid, known.machine.stroke_mm[PLACES[name][0]])
    return np.asarray(operator @ known.motion(name, at))


Values = tuple[F2, F2, F2]
"""Corrections as functions of X, of Y and of Z, each of shape (points, 3 outputs), mm."""


def table_values(
    known: Identified, field: Callable[[F2], F2], sets: tuple[Grids, ...], reference_mm: F1, *, smooth: bool = False
) -> tuple[Values, ...]:
    """Return, for each set of grids, the nine one-axis tables that best correct a field. Each table is zero at the reference.

    ``field``: function from positions (n, 3) to deviations (n, 3), mm; the tables depend linearly on it. ``smooth``: the field is a sum of
    terms of ``known``, so polynomials through few positions per axis replace its evaluation at every position.
    """
    stroke = known.machine.stroke_mm
    fits = [[line_fit(grids[a], stroke[a]) for grids in sets] for a in range(3)]
    x, y, z = (np.concatenate([at for at, _ in fits[a]]) for a in range(3))
    order = max(t.order for t in known.terms) + 1
    asked = [_chebyshev(s, order + 1) if smooth else p for s, p in zip(stroke, (x, y, z), strict=True)]
    found_ = additive(
        lambda p: field(p)[:, :, None], stroke, (asked[0], asked[1], asked[2]), nodes=NODES, order=diagonal_order(known.terms)
    )
    effects = [e[:, :, 0] for e in found_]
    if smooth:
        bases = [(legendre_values(asked[a], stroke[a], order), legendre_values(p, stroke[a], order)) for a, p in enumerate((x, y, z))]
        effects = [there @ np.linalg.solve(here, e) for (here, there), e in zip(bases, effects, strict=True)]
    out = []
    for s, grids in enumerate(sets):
        found = []
        for a in range(3):
            first = sum(fits[a][k][0].size for k in range(s))
            at, operator = fits[a][s]
            values = -(operator @ effects[a][first : first + at.size])
            found.append(values - [np.interp(reference_mm[a], grids[a], values[:, i]) for i in range(3)])
        out.append((found[0], found[1], found[2]))
    return tuple(out)


def _chebyshev(stroke_mm: F1, n: int) -> F1:
    """Return the Chebyshev nodes on a stroke for a polynomial with n coefficients."""
    return np.asarray(stroke_mm.mean() - 0.5 * np.ptp(stroke_mm) * np.cos((np.arange(n) + 0.5) * np.pi / n))


def axis_tables(known: Identified, grids: Grids, values: Values) -> tuple[AxisTable, ...]:
    """Build nine tables from values; own-axis tables have both directions.

    Forward columns are zero at the reference, which is approached in +. While an axis with lost motion B moves in −, it stands B further
    in +, so its backward column is the forward one minus B.
    """
    out = []
    for a, axis in enumerate(AXES):
        for i, output in enumerate(AXES):
            forward = values[a][:, i]
            backward = forward - known.lost_motion_mm.get(axis, 0.0) if i == a else forward
            out.append(AxisTable(axis, output, grids[a], forward, backward))
    return tuple(out)


def lattice_of(known: Identified, grids: Grids, reference_mm: F1) -> Lattice:
    """Return the best 3-D grid, zero at the reference. Each term is fitted along its own axis; along the others it is linear (rule G)."""
    counts = tuple(g.size for g in grids)
    total: F2 = np.zeros((int(np.prod(counts)), 3))
    for a in range(3):
        mine = [i for i, t in enumerate(known.terms) if t.axis == a]
        stroke = known.machine.stroke_mm
        along, operator = line_fit(grids[a], stroke[a])
        at = [along if k == a else np.clip(g, *stroke[k]) for k, g in enumerate(grids)]
        values = design(known.machine, tuple(known.terms[i] for i in mine), nodes_mm((at[0], at[1], at[2]))) @ known.coefficients[mine]
        cube = values.reshape(*(p.size for p in at), 3)
        total = total + np.moveaxis(np.tensordot(operator, cube, (1, a)), 0, a).reshape(-1, 3)
    found = Lattice(grids, -total.reshape(*counts, 3))
    here = tuple(int(np.argmin(np.abs(g - reference_mm[a]))) for a, g in enumerate(grids))
    return Lattice(grids, found.correction_mm - found.correction_mm[here])


def motions_of(known: Identified, grids: Grids) -> Motions:
    """Return all identified error motions. Together they are right for the measured tool, even if single motions are not observable."""
    curves = {}
    for name, (axis, _) in PLACES.items():
        if any(t.motion == name for t in known.terms):
            curves[name] = AxisCurve(AXES[axis], grids[axis], _sampled(known, name, grids[axis]))
    square = {t.motion: float(v) for t, v in zip(known.terms, known.coefficients, strict=True) if t.motion in SQUARENESS}
    return Motions(known.machine, curves, square)
