"""Derivative of the tool's deviation with respect to every error motion and every squareness, first order and exact, any of the 24 chains.

What a calibration needs: which error moves the tool where, at each position. Columns are in the units of the motions: mm per mm for
translations, mm per rad for rotations and squareness.
"""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2, F3, F4
from abbe.models.geometry.bases import smooth_terms, term_values
from abbe.models.geometry.chain import checked, checked_axes
from abbe.models.geometry.rotation import cross_matrix, rotation_matrix, turn_vector, turn_vector_slope
from abbe.models.machine import Machine, levers_mm, split_chain

SQUARENESS = tuple(t for t in smooth_terms(1) if t.order == 0)
"""C0Y, B0Z, A0Z: which translation of which axis each of them is (docs/explanation/conventions.md)."""


def motion_jacobian(machine: Machine, axes_mm: F2, tool_mm: F1 | F2 | None = None) -> F4:
    """First order: derivative of the deviation with respect to each error motion (math.md 2, rule G: Σ_j d_j + E_j × r_j).

    Parameters
    ----------
    axes_mm : array, shape (n, 3)
        Commanded positions.
    tool_mm : array, shape (3,) or (n, 3), optional
        Tool in place of ``machine.tool_mm``.

    Returns
    -------
    array, shape (n, 3 components of the deviation, 3 carriages X Y Z, 6)
        Last index EX EY EZ (mm per mm) and EA EB EC (mm per rad) of that carriage. Rule G is linear: summed over the last two with the
        motions it is `abbe.models.geometry.chain.deviation_mm`, exactly.

    Raises
    ------
    ValueError
        ``axes_mm`` or ``tool_mm`` has another shape.
    """
    r = levers_mm(machine, checked_axes(axes_mm), tool_mm)
    out: F4 = np.zeros((r.shape[0], 3, 3, 6))
    out[..., :3] = np.eye(3)[:, None, :]
    out[..., 3:] = np.swapaxes(-cross_matrix(r), 1, 2)
    return out


def exact_jacobian(machine: Machine, axes_mm: F2, motions: F3, tool_mm: F1 | F2 | None = None) -> F4:
    """The same of the exact kinematics with rotation vectors, at given errors (docs/explanation/conventions.md, "Exact kinematics").

    Analytic: each carriage turns what the carriages before it contributed, and its own turn is Rodrigues' formula differentiated. Without
    errors it is `motion_jacobian`.

    Parameters
    ----------
    axes_mm : array, shape (n, 3)
    motions : array, shape (n, 3 axes, 6)
        Where to differentiate: EX EY EZ (mm, squareness included), EA EB EC (rad), ISO signs.
    tool_mm : array, shape (3,) or (n, 3), optional

    Returns
    -------
    array, shape (n, 3, 3, 6), as `motion_jacobian`; derivative of ``exact_deviation_mm(..., rotation="vector")``.

    Raises
    ------
    ValueError
        Shapes do not agree.
    """
    axes_mm, motions = checked(axes_mm, motions)
    work, tool = split_chain(machine.chain)
    r = levers_mm(machine, axes_mm, tool_mm)
    n = axes_mm.shape[0]
    off: F2 = np.zeros((n, 3))
    out: F4 = np.zeros((n, 3, 3, 6))
    for j in (*reversed(tool), *reversed(work)):
        moved, turned = motions[:, j, :3], motions[:, j, 3:]
        if j in work:  # a table is displaced before it turns, a head after
            off = off + moved
            out[:, :, j, :3] = np.eye(3)
        arm = r[:, j] + off
        out = (rotation_matrix(turned) @ out.reshape(n, 3, 18)).reshape(n, 3, 3, 6)
        out[:, :, j, 3:] = turn_vector_slope(turned, arm)
        off = off + turn_vector(turned, arm)
        if j in tool:
            off = off + moved
            out[:, :, j, :3] = np.eye(3)
    return out


def squareness_motions(axes_mm: F2, start_mm: F1 | None = None) -> F4:
    """Error motions per unit of squareness: slope times travel, signs of docs/explanation/conventions.md (X the datum).

    C0Y gives EXY = −C0Y·y, B0Z gives EXZ = +B0Z·z, A0Z gives EYZ = −A0Z·z.

    Parameters
    ----------
    axes_mm : array, shape (n, 3)
    start_mm : array, shape (3,), optional
        Position at which the travel of X, Y, Z is zero. Default: the axis zero, as the papers' matrices write it (−αX). Solutions of this
        program (`abbe.models.geometry.bases.term_values`) count from the start of the stroke, ``machine.stroke_mm[:, 0]``, where
        positioning and angles are zero too. To first order the choice shifts the whole map by a constant and changes no shape.

    Returns
    -------
    array, shape (n, 3 axes, 6, 3): EX EY EZ EA EB EC of X, Y, Z per rad of C0Y, B0Z, A0Z.

    Raises
    ------
    ValueError
        Another shape.
    """
    axes_mm = checked_axes(axes_mm)
    start = np.zeros(3) if start_mm is None else np.asarray(start_mm, dtype=np.float64)
    if start.shape != (3,):
        raise ValueError(f"squareness: start_mm must have shape (3,), got {start.shape}")
    travel = term_values(SQUARENESS, axes_mm, np.stack([start, start + 1.0], axis=1))
    out: F4 = np.zeros((axes_mm.shape[0], 3, 6, 3))
    for k, t in enumerate(SQUARENESS):
        out[:, t.axis, t.component, k] = travel[:, k]
    return out


def squareness_jacobian(axes_mm: F2, start_mm: F1 | None = None, *, motion: F4 | None = None) -> F3:
    """Derivative of the deviation with respect to C0Y, B0Z, A0Z, where they enter as slope times travel.

    Parameters
    ----------
    axes_mm, start_mm
        As in `squareness_motions`.
    motion : array, shape (n, 3, 3, 6), optional
        An `exact_jacobian`, to go through the exact kinematics. Without it first order, where chain, tool and pivots do not matter.

    Returns
    -------
    array, shape (n, 3 components, 3 of C0Y B0Z A0Z), mm per rad.

    Raises
    ------
    ValueError
        Another shape.
    """
    per_angle = squareness_motions(axes_mm, start_mm)
    if motion is None:
        return np.asarray(per_angle[:, :, :3].sum(axis=1))
    wanted = (per_angle.shape[0], 3, 3, 6)
    if np.shape(motion) != wanted:
        raise ValueError(f"squareness: motion must have shape {wanted}, got {np.shape(motion)}")
    return np.asarray(np.einsum("nijm,njmk->nik", motion, per_angle))
