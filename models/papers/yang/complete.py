"""Yang and Kim's complete volumetric error model with all 21 errors, eq (1), as printed, and the readings of a ball-bar, eq (4)-(8)
(math.md 4.1, 4.2).

Eq (1) is rule G for the chain `abbe.models.notation.yang.CHAIN`; written out here term by term so that the paper can be read next to it.
Readings are exact, or of first order, with a bound on the difference.
"""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.functions.monomials import ErrorArrays, Monomial, error_arrays, individual_terms
from abbe.models.geometry.chain import deviation_mm, exact_deviation_mm
from abbe.models.notation.yang import YangErrors, iso_motions, machine, workpiece_mm

ANGLE_MM = 500.0
"""The reference vectors state angles and squareness times this length, so that all coefficients are lengths of like size."""


def delta_eq1(errors: YangErrors, slide_mm: F2, tool_mm: F1) -> F2:
    """Volumetric error of the complete model, eq (1), in workpiece coordinates.

    Parameters
    ----------
    errors : YangErrors
        The 21 errors at the n positions.
    slide_mm : array, shape (n, 3)
        x, y, z of the machine's scales; z is the travel of the cross slide that carries the workpiece.
    tool_mm : array, shape (3,)
        (Tx, Ty, Tz + L).

    Returns
    -------
    array, shape (n, 3), mm, actual minus nominal, tool relative to workpiece.

    Raises
    ------
    ValueError
        Errors and positions differ in number, or the tool is not three numbers.
    """
    n, shape, tool = errors.d.shape[0], np.shape(slide_mm), np.shape(tool_mm)
    if shape != (n, 3) or tool != (3,):
        raise ValueError(f"eq (1): errors of {n} positions do not fit positions of shape {shape}, or tool {tool} is not (3,)")
    x, y, z = np.asarray(slide_mm, dtype=np.float64).T
    tx, ty, tz = (float(t) for t in tool_mm)
    d, e = errors.d.transpose(1, 2, 0), errors.e.transpose(1, 2, 0)
    out = np.empty((x.size, 3))
    out[:, 0] = d[0, 0] + d[0, 1] - d[0, 2] + tz * (e[1, 0] + e[1, 1]) - (tz - z) * e[1, 2]
    out[:, 0] += -(ty + y) * e[2, 0] - ty * e[2, 1] + (ty + y) * e[2, 2] - y * errors.sxy
    out[:, 1] = d[1, 0] + d[1, 1] - d[1, 2] - tz * (e[0, 0] + e[0, 1]) + (tz - z) * e[0, 2]
    out[:, 1] += tx * (e[2, 0] + e[2, 1]) - (tx + x) * e[2, 2]
    out[:, 2] = d[2, 1] + d[2, 0] - d[2, 2] + (ty + y) * e[0, 0] + ty * e[0, 1] - (ty + y) * e[0, 2]
    out[:, 2] += -tx * (e[1, 0] + e[1, 1]) + (tx + x) * e[1, 2] - x * errors.sxz - y * errors.syz
    return out


def difference_eq3(errors: YangErrors, slide_mm: F2, tool_mm: F1) -> F2:
    """What the simplified model leaves out, eq (3): complete minus simplified model, shape (n, 3), mm.

    Eq (1) without the three positioning errors delta_jj and the three squareness errors. Parameters: as `delta_eq1`.
    """
    d = errors.d.copy()
    d[:, range(3), range(3)] = 0.0
    return delta_eq1(YangErrors(d, errors.e), slide_mm, tool_mm)


def delta_exact(errors: YangErrors, slide_mm: F2, tool_mm: F1, *, small_angles: bool = False) -> F2:
    """`delta_eq1` without linearisation: full rotations Rz Ry Rx, or (``small_angles``) the paper's matrices multiplied out exactly.

    Parameters, result: as `delta_eq1`.
    """
    form = machine(np.array([[0.0, 1.0]] * 3), tool_mm)
    return exact_deviation_mm(form, workpiece_mm(slide_mm), iso_motions(errors, slide_mm), rotation="small" if small_angles else "zyx")


def monomial_errors(terms: tuple[Monomial, ...], theta: F1, slide_mm: F2, travel_mm: F1) -> YangErrors:
    """The 21 errors of a machine stated by coefficients of u = scale / travel, the form of the reference vectors (math.md 4.6).

    Parameters
    ----------
    terms, theta : tuple of Monomial, array of shape (len(terms),)
        Coefficients in mm: angles and squareness are stated times `ANGLE_MM`. Signs of the paper: Z's are the slide's own, squareness is
        obtuse positive.
    slide_mm : array, shape (n, 3)
        Scales x, y, z (z of the cross slide).
    travel_mm : array, shape (3,)

    Returns
    -------
    YangErrors
        delta_ij (mm), eps_ij (rad) at the n positions, squareness (rad).

    Raises
    ------
    ValueError
        Numbers of terms and coefficients differ.
    """
    return _as_errors(error_arrays(terms, theta, np.asarray(slide_mm) / travel_mm, 1.0 / ANGLE_MM))


def monomial_field(terms: tuple[Monomial, ...], points_mm: F2, travel_mm: F1, tool_mm: F1) -> F3:
    """Deviation per unit of each coefficient of `monomial_errors`, first order: eq (1) as a design (math.md 4.6).

    Parameters
    ----------
    terms : tuple of Monomial
    points_mm : array, shape (n, 3)
        WORKPIECE coordinates (x, y, -z slide).
    travel_mm, tool_mm : array, shape (3,)
        Travels; (Tx, Ty, Tz + L).

    Returns
    -------
    array, shape (n, 3, len(terms))
        mm per mm of coefficient (angles and squareness times `ANGLE_MM`), workpiece coordinates, actual minus nominal.
    """
    slide = workpiece_mm(points_mm)
    form = machine(np.array([[0.0, 1.0]] * 3), tool_mm)
    out = np.empty((len(slide), 3, len(terms)))
    for which, values in individual_terms(terms, slide / travel_mm, 1.0 / ANGLE_MM):
        times = which.stop - which.start
        positions_mm = np.tile(slide, (times, 1))
        deviations_mm = deviation_mm(form, np.tile(points_mm, (times, 1)), iso_motions(_as_errors(values), positions_mm))
        out[:, :, which] = deviations_mm.reshape(times, len(slide), 3).transpose(1, 2, 0)
    return out


def _as_errors(a: ErrorArrays) -> YangErrors:
    return YangErrors(a.d, a.e, float(a.s[0]), float(a.s[1]), float(a.s[2]))


def reading_eq6(d_mm: F2, error_mm: F2) -> F1:
    """Change of the bar's length, eq (6) without linearisation: |d + error| - |d|.

    Parameters
    ----------
    d_mm : array, shape (n, 3)
        Nominal position minus nominal centre, w - w0, WORKPIECE coordinates.
    error_mm : array, shape (n, 3)
        Delta - Delta0: error at the position minus the error (or the mounting offset) of the centre.

    Returns
    -------
    array, shape (n,), mm, positive = longer. Computed without subtracting the two lengths, so that no digits are lost. Erratum: in the
    printed (6) and (7) the fraction bar runs into the root (math.md 3).

    Raises
    ------
    ValueError
        Shapes differ, or a point lies at the centre: no bar has length 0.
    """
    _bar_mm(d_mm, error_mm)
    change = np.einsum("ni,ni->n", error_mm, 2.0 * d_mm + error_mm)
    return np.asarray(change / (np.linalg.norm(d_mm + error_mm, axis=1) + np.linalg.norm(d_mm, axis=1)))


def reading_eq8(d_mm: F2, error_mm: F2) -> F1:
    """`reading_eq6` to first order, eq (8): (w - w0) . (Delta - Delta0) / R, shape (n,), mm.

    Parameters, errors: as `reading_eq6`; R is the length of each row of ``d_mm``. Erratum: the paper takes the slide's z for a workpiece
    coordinate; WORKPIECE coordinates are wanted here (math.md 3 row Y (8), 4.2). What it leaves out: `second_order_bound_mm`.
    """
    return np.asarray(np.einsum("ni,ni->n", d_mm, error_mm) / _bar_mm(d_mm, error_mm))


def second_order_bound_mm(error_mm: F2, radius_mm: float) -> F1:
    """Largest possible difference of the two, |Delta - Delta0|² / (2 R), to second order, shape (n,), mm (math.md 4.2).

    Raises
    ------
    ValueError
        Radius not positive.
    """
    _positive(radius_mm)
    return np.asarray((error_mm**2).sum(axis=1) / (2.0 * radius_mm))


def measured_mm(tip_mm: F2, ball_mm: F1, radius_mm: float, bar_offset_mm: float = 0.0) -> F1:
    """Bar reading from the actual positions of the two balls: |tip - ball| - R + offset, shape (n,).

    Parameters
    ----------
    tip_mm, ball_mm : array, shape (n, 3) and (3,)
        Actual tool tips and the fixed ball, workpiece coordinates (set-up error of the ball included).
    radius_mm, bar_offset_mm : float
        Nominal length; how much longer the bar reads than it is.

    Raises
    ------
    ValueError
        Radius not positive.
    """
    _positive(radius_mm)
    return np.asarray(np.linalg.norm(tip_mm - ball_mm, axis=1) - radius_mm + bar_offset_mm)


def _bar_mm(d_mm: F2, error_mm: F2) -> F1:
    """Nominal lengths, shape (n,), none of them 0."""
    if np.ndim(d_mm) != 2 or np.shape(d_mm)[1] != 3 or np.shape(error_mm) != np.shape(d_mm):
        raise ValueError(f"ball-bar: positions {np.shape(d_mm)} and errors {np.shape(error_mm)} must both have shape (n, 3)")
    length: F1 = np.linalg.norm(d_mm, axis=1)
    if not (length > 0).all():
        raise ValueError(f"ball-bar: point {int(np.argmin(length > 0))} lies at the centre (or nowhere), a bar has a length")
    return length


def _positive(radius_mm: float) -> None:
    if not 0 < radius_mm < np.inf:
        raise ValueError(f"ball-bar: radius {radius_mm} mm must be positive")
