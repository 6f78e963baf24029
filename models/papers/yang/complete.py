"""Yang and Kim's complete volumetric model with all 21 errors, (1), as printed, and the readings of a ball-bar, (4)-(8).

Equation (1) is the first-order deviation (rule G, docs/explanation/conventions.md) of the chain `abbe.models.notation.yang.CHAIN`, written
out term by term for comparison with the paper. Ball-bar readings are exact or of first order, with a bound on the difference.
"""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.functions.monomials import ErrorArrays, Monomial, error_arrays, individual_terms
from abbe.models.geometry.chain import deviation_mm, exact_deviation_mm
from abbe.models.notation.yang import YangErrors, iso_motions, machine, workpiece_mm

ANGLE_MM = 500.0
"""The reference vectors multiply angles and squareness by this length, so that all coefficients are lengths of similar size."""


def delta_eq1(errors: YangErrors, slide_mm: F2, tool_mm: F1) -> F2:
    """Return the volumetric error of the complete model, (1), in workpiece coordinates.

    Parameters
    ----------
    errors : YangErrors
        The 21 errors at the n positions.
    slide_mm : array, shape (n, 3)
        Scale readings x, y, z; z is the travel of the cross slide, which carries the workpiece.
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
    """Return the complete minus the simplified model, (3), shape (n, 3), mm.

    The difference is (1) without the three positioning errors delta_jj and the three squareness errors. Parameters: those of `delta_eq1`.
    """
    d = errors.d.copy()
    d[:, range(3), range(3)] = 0.0
    return delta_eq1(YangErrors(d, errors.e), slide_mm, tool_mm)


def delta_exact(errors: YangErrors, slide_mm: F2, tool_mm: F1, *, small_angles: bool = False) -> F2:
    """Return `delta_eq1` without linearisation: with full rotations Rz Ry Rx or, with ``small_angles``, with the paper's matrices.

    Parameters and result are those of `delta_eq1`.
    """
    form = machine(np.array([[0.0, 1.0]] * 3), tool_mm)
    return exact_deviation_mm(form, workpiece_mm(slide_mm), iso_motions(errors, slide_mm), rotation="small" if small_angles else "zyx")


def monomial_errors(terms: tuple[Monomial, ...], theta: F1, slide_mm: F2, travel_mm: F1) -> YangErrors:
    """Evaluate the 21 errors of a machine given by coefficients of u = scale / travel, as in the reference vectors.

    Parameters
    ----------
    terms, theta : tuple of Monomial, array of shape (len(terms),)
        Coefficients in mm; those of angles and squareness are multiplied by `ANGLE_MM`. Signs of the paper: errors of Z are the slide's
        own, squareness is obtuse positive.
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
    """Return the first-order deviation, (1), per unit of each coefficient of `monomial_errors`.

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
        mm per mm of coefficient, workpiece coordinates, actual minus nominal.
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
    """Return the change of the bar's length, (6) without linearisation: |d + error| - |d|.

    Parameters
    ----------
    d_mm : array, shape (n, 3)
        Nominal position minus nominal centre, w - w0, WORKPIECE coordinates.
    error_mm : array, shape (n, 3)
        Delta - Delta0: error at the position minus the error (or the mounting offset) of the centre.

    Returns
    -------
    array, shape (n,), mm, positive = longer; computed without the difference of two lengths. Erratum: in the printed (6) and (7) the root
    sign is lost in the fraction bar.

    Raises
    ------
    ValueError
        Shapes differ, or a point lies at the centre.
    """
    _bar_mm(d_mm, error_mm)
    change = np.einsum("ni,ni->n", error_mm, 2.0 * d_mm + error_mm)
    return np.asarray(change / (np.linalg.norm(d_mm + error_mm, axis=1) + np.linalg.norm(d_mm, axis=1)))


def reading_eq8(d_mm: F2, error_mm: F2) -> F1:
    """Return `reading_eq6` to first order, (8): (w - w0) . (Delta - Delta0) / R, shape (n,), mm.

    Parameters and errors are those of `reading_eq6`; R is the length of each row of ``d_mm``. Erratum: the paper uses the z of the slide in
    place of the workpiece coordinate. `second_order_bound_mm` bounds the neglected part.
    """
    return np.asarray(np.einsum("ni,ni->n", d_mm, error_mm) / _bar_mm(d_mm, error_mm))


def second_order_bound_mm(error_mm: F2, radius_mm: float) -> F1:
    """Return the largest difference of `reading_eq6` and `reading_eq8` to second order, |Delta - Delta0|² / (2 R), shape (n,), mm.

    Raises
    ------
    ValueError
        Radius not positive.
    """
    _positive(radius_mm)
    return np.asarray((error_mm**2).sum(axis=1) / (2.0 * radius_mm))


def measured_mm(tip_mm: F2, ball_mm: F1, radius_mm: float, bar_offset_mm: float = 0.0) -> F1:
    """Return the bar reading from the actual positions of the two balls, |tip - ball| - R + offset, mm, shape (n,).

    Parameters
    ----------
    tip_mm, ball_mm : array, shape (n, 3) and (3,)
        Actual positions of tool tip and fixed ball (with its set-up error), workpiece coordinates.
    radius_mm, bar_offset_mm : float
        Nominal length, and excess of the reading over the actual length.

    Raises
    ------
    ValueError
        Radius not positive.
    """
    _positive(radius_mm)
    return np.asarray(np.linalg.norm(tip_mm - ball_mm, axis=1) - radius_mm + bar_offset_mm)


def _bar_mm(d_mm: F2, error_mm: F2) -> F1:
    """Return the nominal lengths, shape (n,); ValueError if one is 0."""
    if np.ndim(d_mm) != 2 or np.shape(d_mm)[1] != 3 or np.shape(error_mm) != np.shape(d_mm):
        raise ValueError(f"ball-bar: positions {np.shape(d_mm)} and errors {np.shape(error_mm)} must both have shape (n, 3)")
    length: F1 = np.linalg.norm(d_mm, axis=1)
    if not (length > 0).all():
        raise ValueError(f"ball-bar: point {int(np.argmin(length > 0))} lies at the centre or is not finite; its bar would have no length")
    return length


def _positive(radius_mm: float) -> None:
    if not 0 < radius_mm < np.inf:
        raise ValueError(f"ball-bar: radius {radius_mm} mm must be positive")
