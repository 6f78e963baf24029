"""Deviation of the tool relative to the workpiece for any of the 24 chains, and its derivatives.

The deviation comes to first order by rule G (docs/explanation/conventions.md) or from the exact transforms. Derivatives with
respect to error motions and squareness exist for both: mm per mm for translations, mm per rad for rotations and squareness.
"""

from __future__ import annotations

from itertools import permutations

import numpy as np
from numpy.typing import ArrayLike

from abbe.models.arrays import F1, F2, F3, F4
from abbe.models.geometry.bases import Term, layout_of, smooth_terms, term_values
from abbe.models.geometry.rotation import RotationForm, cross, cross_matrix, rotation_matrix, turn_vector, turn_vector_slope, turned_by
from abbe.models.machine import AXES, Machine, levers_mm, split_chain


def all_chains() -> tuple[str, ...]:
    """Return the 24 serial arrangements of three carriages: 6 orders times 4 positions of the bed, e.g. ``"w-X-Y-b-Z-t"``."""
    return tuple("-".join(("w", *order[:k], "b", *order[k:], "t")) for order in permutations(AXES) for k in range(4))


def checked_axes(axes_mm: ArrayLike) -> F2:
    """Return commanded positions as float64; ValueError if the shape is not (n, 3). NaN is allowed."""
    axes = np.asarray(axes_mm, dtype=np.float64)
    if axes.ndim != 2 or axes.shape[1] != 3:
        raise ValueError(f"chain: axes_mm must have shape (n, 3), got {axes.shape}")
    return axes


def checked(axes_mm: ArrayLike, motions: ArrayLike) -> tuple[F2, F3]:
    """Return positions and motions as float64; ValueError if their shapes are not (n, 3) and (n, 3, 6). NaN is allowed."""
    axes, values = np.asarray(axes_mm, dtype=np.float64), np.asarray(motions, dtype=np.float64)
    n = axes.shape[0] if axes.ndim else 0
    if axes.shape != (n, 3) or values.shape != (n, 3, 6):
        raise ValueError(f"chain: axes_mm must have shape (n, 3) and motions (n, 3, 6), got {axes.shape} and {values.shape}")
    return axes, values


def deviation_mm(machine: Machine, axes_mm: F2, motions: F3, tool_mm: F1 | F2 | None = None) -> F2:
    """Return the first-order deviation of the functional point for given error motions (rule G, docs/explanation/conventions.md).

    Parameters
    ----------
    axes_mm : array, shape (n, 3)
        Commanded positions.
    motions : array, shape (n, 3 axes, 6)
        EX EY EZ (mm, squareness included) and EA EB EC (rad) of the X, Y, Z carriage at these positions, ISO signs.
    tool_mm : array, shape (3,) or (n, 3), optional
        Tool vector in place of ``machine.tool_mm``: one for all points or one per point.

    Returns
    -------
    array, shape (n, 3)
        Actual minus nominal, tool relative to workpiece, mm. NaN in the input gives NaN in the same row.

    Raises
    ------
    ValueError
        An array has another shape.
    """
    axes_mm, motions = checked(axes_mm, motions)
    r = levers_mm(machine, axes_mm, tool_mm)
    total: F2 = (motions[:, :, :3] + cross(motions[:, :, 3:], r)).sum(axis=1)
    return total


def exact_deviation_mm(
    machine: Machine, axes_mm: F2, motions: F3, tool_mm: F1 | F2 | None = None, *, rotation: RotationForm = "vector"
) -> F2:
    """Return the deviation with finite rotations (docs/explanation/conventions.md, "Exact kinematics").

    Parameters, result and errors are those of `deviation_mm`. The chain adds up displacements, never positions, so the rounding error is
    relative to the deviation and not to the size of the machine.

    Parameters
    ----------
    rotation : "vector", "zyx" or "small"
        How three angles make a rotation; the forms differ in second order only, and Pahk (1), (3) leave the choice open. ``vector``: by the
        vector E. ``zyx``: Rz(EC) Ry(EB) Rx(EA) of the carriage's own rotation; a work-side carriage's own rotation is −E, and its transform
        is inverted exactly. ``small``: the papers' I + [E]×; on the work side, the exact inverse of I + [−E]×.
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
    """Return the first-order derivative of the deviation with respect to every coefficient, shape (n, 3, len(terms)).

    Coefficients are in mm for translations, in rad for rotations and squareness. ``design @ coefficients`` is the deviation by rule G.
    """
    per_motion = motion_jacobian(machine, axes_mm).reshape(-1, 3, 18)
    out: F3 = per_motion[:, :, layout_of(terms).motion]
    out *= term_values(terms, axes_mm, machine.stroke_mm)[:, None]
    return out


REST_MM = 1e-8
"""A smaller difference of two commanded positions is rounding, not motion."""


def travel_sign(axes_mm: F2) -> F2:
    """Return the direction in which each axis last moved, -1, 0 or +1, shape (n, 3), for a sequence of positions.

    An axis at rest keeps its last sign. Before its first motion it has the sign of this motion, because sequences approach their start in
    that direction; an axis that never moves has 0.
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


SQUARENESS = tuple(t for t in smooth_terms(1) if t.order == 0)
"""Terms of C0Y, B0Z, A0Z (docs/explanation/conventions.md)."""


def motion_jacobian(machine: Machine, axes_mm: F2, tool_mm: F1 | F2 | None = None) -> F4:
    """Return the first-order derivative of the deviation with respect to each error motion (rule G: Σ_j d_j + E_j × r_j).

    Parameters
    ----------
    axes_mm : array, shape (n, 3)
        Commanded positions.
    tool_mm : array, shape (3,) or (n, 3), optional
        Tool vector in place of ``machine.tool_mm``.

    Returns
    -------
    array, shape (n, 3 components of the deviation, 3 carriages X Y Z, 6)
        Last index: EX EY EZ (mm per mm) and EA EB EC (mm per rad) of that carriage. The sum of products with the motions is
        `deviation_mm`.

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
    """Return the derivative of the exact deviation, with rotation vectors, with respect to each error motion, at given motions.

    The derivative is analytic: each carriage rotates the contributions of the carriages before it, and Rodrigues' formula is
    differentiated. At zero motions it equals `motion_jacobian`.

    Parameters
    ----------
    axes_mm : array, shape (n, 3)
    motions : array, shape (n, 3 axes, 6)
        Motions at which to differentiate: EX EY EZ (mm, squareness included), EA EB EC (rad), ISO signs.
    tool_mm : array, shape (3,) or (n, 3), optional
        Tool vector in place of ``machine.tool_mm``.

    Returns
    -------
    array, shape (n, 3, 3, 6), as from `motion_jacobian`; derivative of ``exact_deviation_mm(..., rotation="vector")``.

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
        if j in work:  # a work-side carriage is displaced before it turns, a tool-side one after
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
    """Return the error motions per rad of squareness: slope times travel, with X as the datum (docs/explanation/conventions.md).

    C0Y gives EXY = −C0Y·y, B0Z gives EXZ = +B0Z·z, A0Z gives EYZ = −A0Z·z.

    Parameters
    ----------
    axes_mm : array, shape (n, 3)
    start_mm : array, shape (3,), optional
        Position at which the travel of X, Y, Z is zero. Default: the axis zero, as in the papers' matrices (−αX). Abbe's solutions
        (`abbe.models.geometry.bases.term_values`) use the start of the stroke, ``machine.stroke_mm[:, 0]``. To first order the
        choice only shifts the whole map by a constant.

    Returns
    -------
    array, shape (n, 3 axes, 6, 3): EX EY EZ EA EB EC of X, Y, Z per rad of C0Y, B0Z, A0Z.

    Raises
    ------
    ValueError
        An array has another shape.
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
    """Return the derivative of the deviation with respect to C0Y, B0Z, A0Z, which act as slope times travel.

    Parameters
    ----------
    axes_mm, start_mm
        As in `squareness_motions`.
    motion : array, shape (n, 3, 3, 6), optional
        Result of `exact_jacobian`, for the exact kinematics. Default: first order, which does not depend on chain, tool and pivots.

    Returns
    -------
    array, shape (n, 3 components, 3 of C0Y B0Z A0Z), mm per rad.

    Raises
    ------
    ValueError
        An array has another shape.
    """
    per_angle = squareness_motions(axes_mm, start_mm)
    if motion is None:
        return np.asarray(per_angle[:, :, :3].sum(axis=1))
    wanted = (per_angle.shape[0], 3, 3, 6)
    if np.shape(motion) != wanted:
        raise ValueError(f"squareness: motion must have shape {wanted}, got {np.shape(motion)}")
    return np.asarray(np.einsum("nijm,njmk->nik", motion, per_angle))
