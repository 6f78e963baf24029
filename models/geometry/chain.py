"""Deviation of the tool relative to the workpiece: rule G (first order), its design matrix, and the exact transforms."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from models.arrays import F1, F2, F3
from models.geometry.bases import Term, term_values
from models.machine import Machine, levers_mm, split_chain


def deviation_mm(machine: Machine, axes_mm: F2, motions: F3) -> F2:
    """First-order deviation of the functional point for given error motions (math.md 2, rule G).

    Parameters
    ----------
    axes_mm : array, shape (n, 3)
        Commanded positions.
    motions : array, shape (n, 3 axes, 6)
        EX EY EZ (mm, squareness included) and EA EB EC (rad) of the X, Y, Z carriage at these positions, ISO signs.

    Returns
    -------
    array, shape (n, 3)
        Actual minus nominal, tool relative to workpiece, mm.
    """
    r = levers_mm(machine, axes_mm)
    total: F2 = (motions[:, :, :3] + np.cross(motions[:, :, 3:], r)).sum(axis=1)
    return total


def exact_deviation_mm(machine: Machine, axes_mm: F2, motions: F3) -> F2:
    """The same with finite rotations (docs/conventions.md, "Exact kinematics"); shapes as in `deviation_mm`."""
    work, tool = split_chain(machine.chain)
    n = axes_mm.shape[0]
    p = np.broadcast_to(machine.tool_mm, (n, 3)).copy()
    unit = np.eye(3)
    for j in reversed(tool):
        rot = Rotation.from_rotvec(motions[:, j, 3:])
        p = machine.pivots_mm[j] + rot.apply(p - machine.pivots_mm[j]) + axes_mm[:, j, None] * unit[j] + motions[:, j, :3]
    for j in reversed(work):
        rot = Rotation.from_rotvec(motions[:, j, 3:])
        p = machine.pivots_mm[j] + rot.apply(p + axes_mm[:, j, None] * unit[j] + motions[:, j, :3] - machine.pivots_mm[j])
    return np.asarray(p - axes_mm - machine.tool_mm)


def design(machine: Machine, terms: tuple[Term, ...], axes_mm: F2) -> F3:
    """Derivative of the deviation with respect to every term's coefficient, shape (n, 3, len(terms)).

    Coefficients are mm for translations, rad for rotations and squareness. Rule G is linear, so ``design @ coefficients`` is the deviation.
    """
    values = term_values(terms, axes_mm, machine.stroke_mm)
    r = levers_mm(machine, axes_mm)
    out = np.zeros((axes_mm.shape[0], 3, len(terms)))
    unit = np.eye(3)
    for i, t in enumerate(terms):
        if t.component < 3:
            out[:, t.component, i] = values[:, i]
        else:
            out[:, :, i] = values[:, i, None] * np.cross(unit[t.component - 3], r[:, t.axis])
    return out


def travel_sign(axes_mm: F2) -> F2:
    """Direction in which each axis last moved, -1, 0 or +1, shape (n, 3), for a sequence of positions.

    An axis that rests keeps its last sign; before its first motion it has the sign of that first motion (sequences approach their start
    in that direction), 0 if it never moves.
    """
    step = np.sign(np.diff(axes_mm, axis=0, prepend=axes_mm[:1]))
    for a in range(3):
        s: F1 = step[:, a]
        moved = np.flatnonzero(s)
        if moved.size:
            last = np.maximum.accumulate(np.where(s != 0, np.arange(s.size), -1))
            step[:, a] = np.where(last >= 0, s[np.maximum(last, 0)], s[moved[0]])
    return step
