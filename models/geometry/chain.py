"""Deviation of the tool relative to the workpiece: rule G (first order), its design matrix, and the exact transforms."""

from __future__ import annotations

from itertools import permutations

import numpy as np
from numpy.typing import ArrayLike

from abbe.models.arrays import F1, F2, F3
from abbe.models.geometry.bases import Term, term_values
from abbe.models.geometry.rotation import RotationForm, cross, turned_by
from abbe.models.machine import AXES, Machine, levers_mm, split_chain


def all_chains() -> tuple[str, ...]:
    """The 24 serial arrangements of three carriages, 6 orders times 4 places of the bed, e.g. ``"w-X-Y-b-Z-t"``."""
    return tuple("-".join(("w", *order[:k], "b", *order[k:], "t")) for order in permutations(AXES) for k in range(4))


def checked_axes(axes_mm: ArrayLike) -> F2:
    """Commanded positions as float64 of shape (n, 3); ValueError for another shape. NaN passes: it comes out as NaN."""
    axes = np.asarray(axes_mm, dtype=np.float64)
    if axes.ndim != 2 or axes.shape[1] != 3:
        raise ValueError(f"chain: axes_mm must have shape (n, 3), got {axes.shape}")
    return axes


def checked(axes_mm: ArrayLike, motions: ArrayLike) -> tuple[F2, F3]:
    """Positions and motions as float64 of shapes (n, 3) and (n, 3, 6).

    Raises
    ------
    ValueError
        They have other shapes.
    """
    axes, values = np.asarray(axes_mm, dtype=np.float64), np.asarray(motions, dtype=np.float64)
    n = axes.shape[0] if axes.ndim else 0
    if axes.shape != (n, 3) or values.shape != (n, 3, 6):
        raise ValueError(f"chain: axes_mm must have shape (n, 3) and motions (n, 3, 6), got {axes.shape} and {values.shape}")
    return axes, values


def deviation_mm(machine: Machine, axes_mm: F2, motions: F3, tool_mm: F1 | F2 | None = None) -> F2:
    """First-order deviation of the functional point for given error motions, any of the 24 chains (math.md 2, rule G).

    Parameters
    ----------
    axes_mm : array, shape (n, 3)
        Commanded positions.
    motions : array, shape (n, 3 axes, 6)
        EX EY EZ (mm, squareness included) and EA EB EC (rad) of the X, Y, Z carriage at these positions, ISO signs.
    tool_mm : array, shape (3,) or (n, 3), optional
        Tool in place of ``machine.tool_mm``: one for all points or one per point.

    Returns
    -------
    array, shape (n, 3)
        Actual minus nominal, tool relative to workpiece, mm. NaN in a row of the input is NaN in that row: nothing is checked but shapes.

    Raises
    ------
    ValueError
        Another shape.
    """
    axes_mm, motions = checked(axes_mm, motions)
    r = levers_mm(machine, axes_mm, tool_mm)
    total: F2 = (motions[:, :, :3] + cross(motions[:, :, 3:], r)).sum(axis=1)
    return total


def exact_deviation_mm(
    machine: Machine, axes_mm: F2, motions: F3, tool_mm: F1 | F2 | None = None, *, rotation: RotationForm = "vector"
) -> F2:
    """The same with finite rotations; parameters, result and errors as in `deviation_mm`.

    Source: docs/explanation/conventions.md, "Exact kinematics".

    Only what the errors add is carried along the chain, never the position itself, so the result is good to about 16 digits of its own
    size and not of the machine's.

    Parameters
    ----------
    rotation : "vector", "zyx" or "small"
        How a carriage's three angles make one rotation: by the vector E; Rz(EC) Ry(EB) Rx(EA) of the carriage's own rotation (a table's own
        is −E, and its transform is inverted exactly); or the papers' matrix I + [E]×, on the work side the exact inverse of I + [−E]×.
        Pahk (1), (3) leave the choice open; they differ in second order only.
    """
    axes_mm, motions = checked(axes_mm, motions)
    work, tool = split_chain(machine.chain)
    r = levers_mm(machine, axes_mm, tool_mm)
    moved, turned = motions[:, :, :3], motions[:, :, 3:]
    off: F2 = np.zeros((axes_mm.shape[0], 3))
    for j in reversed(tool):
        off = off + turned_by(rotation, turned[:, j], r[:, j] + off, work_side=False) + moved[:, j]
    for j in reversed(work):
        off = off + moved[:, j]
        off = off + turned_by(rotation, turned[:, j], r[:, j] + off, work_side=True)
    return off


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


REST_MM = 1e-8
"""A difference of two commanded positions below this is rounding (1e-13 of a metre), not a motion: no axis reverses by it."""


def travel_sign(axes_mm: F2) -> F2:
    """Direction in which each axis last moved, -1, 0 or +1, shape (n, 3), for a sequence of positions.

    An axis that rests keeps its last sign; before its first motion it has the sign of that first motion (sequences approach their start
    in that direction), 0 if it never moves.
    """
    moved_mm = np.diff(axes_mm, axis=0, prepend=axes_mm[:1])
    step = np.sign(np.where(np.abs(moved_mm) > REST_MM, moved_mm, 0.0))
    for a in range(3):
        s: F1 = step[:, a]
        moved = np.flatnonzero(s)
        if moved.size:
            last = np.maximum.accumulate(np.where(s != 0, np.arange(s.size), -1))
            step[:, a] = np.where(last >= 0, s[np.maximum(last, 0)], s[moved[0]])
    return step
