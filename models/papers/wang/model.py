"""Wang's volumetric error of the machine FXYZ, eq (9) to (11), corrected and as printed (math.md 3 rows W, 5).

Two slips of the paper: (9) has -y alpha_x(X) in Pz, +y is right (its own (11) has it); (11) has -z theta_xy in Ex(Z), -z theta_xz is right.
Squareness is obtuse positive here (`abbe.models.notation.wang`).
"""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.functions.monomials import ErrorArrays, Monomial, each_alone, error_arrays
from abbe.models.geometry.chain import deviation_mm, exact_deviation_mm
from abbe.models.notation.wang import iso_motions, machine


def position_error_eq9(errors: ErrorArrays, axes_mm: F2) -> F2:
    """Position error (Px, Py, Pz) of eq (9) with its erratum corrected, shape (n, 3), mm; equals rule G for FXYZ and tool 0.

    Parameters
    ----------
    errors : ErrorArrays
        delta_i(J), alpha_i(J) at the n positions; squareness xy, xz, yz obtuse positive.
    axes_mm : array, shape (n, 3)
        x, y, z from the machine's zero.

    Raises
    ------
    ValueError
        Errors and positions differ in number.
    """
    return np.asarray(displacement_eq11(errors, axes_mm).sum(axis=2))


def position_error_eq9_printed(errors: ErrorArrays, axes_mm: F2) -> F2:
    """Eq (9) as printed: the roll of X enters Pz with the wrong sign (erratum W (9)); for comparison only."""
    out = position_error_eq9(errors, axes_mm)
    out[:, 2] -= 2.0 * axes_mm[:, 1] * errors.e[:, 0, 0]
    return out


def displacement_eq11(errors: ErrorArrays, axes_mm: F2) -> F3:
    """Displacement errors E_i(J) of eq (11) with its erratum corrected, shape (n, 3 directions i, 3 axes J), mm.

    Parameters: as `position_error_eq9`. The lever arms are those of the position: with ``axes_mm`` on one axis only the translational part
    is left, which is what a single-axis measurement sees.

    Raises
    ------
    ValueError
        As `position_error_eq9`.
    """
    if np.shape(axes_mm) != (len(errors.d), 3) or errors.d.shape != errors.e.shape:
        raise ValueError(f"Wang errors of {len(errors.d)} positions do not fit positions of shape {np.shape(axes_mm)}")
    _, y, z = np.asarray(axes_mm, dtype=np.float64).T
    a, (xy, xz, yz) = errors.e, errors.s
    out: F3 = errors.d.copy()
    out[:, 0, 0] += z * a[:, 1, 0] - y * a[:, 2, 0]
    out[:, 1, 0] += -z * a[:, 0, 0]
    out[:, 2, 0] += y * a[:, 0, 0]
    out[:, 0, 1] += z * a[:, 1, 1] - y * xy
    out[:, 1, 1] += -z * a[:, 0, 1]
    out[:, 0, 2] += -z * xz
    out[:, 1, 2] += -z * yz
    return out


def displacement_eq11_printed(errors: ErrorArrays, axes_mm: F2) -> F3:
    """Eq (11) as printed: Ex(Z) carries theta_xy in place of theta_xz (erratum W (11)); for comparison only."""
    out = displacement_eq11(errors, axes_mm)
    out[:, 0, 2] += axes_mm[:, 2] * (errors.s[1] - errors.s[0])
    return out


def exact_positions_mm(errors: ErrorArrays, axes_mm: F2) -> F2:
    """Where the mirror really is, full rotations Rz Ry Rx: actual minus nominal, shape (n, 3), mm."""
    return exact_deviation_mm(machine(_ANY), axes_mm, _motions(errors, axes_mm), rotation="zyx")


def monomial_errors(terms: tuple[Monomial, ...], theta: F1, axes_mm: F2, travel_mm: F1, angle_scale: float = 1.0) -> ErrorArrays:
    """The 21 errors of a machine stated by coefficients of u = position / travel, the form of the vectors (math.md 4.6, 5.5).

    Parameters
    ----------
    terms, theta : tuple of Monomial, array of shape (len(terms),)
        Coefficients: mm for delta; for alpha and squareness rad (times ``1 / angle_scale``), obtuse positive as in (9) and (11).
    axes_mm : array, shape (n, 3)
        Commanded positions from the machine's zero.
    travel_mm : array, shape (3,)
    angle_scale : float
        Factor on the coefficients of angles and squareness.

    Returns
    -------
    ErrorArrays
        delta_i(J), mm, and alpha_i(J), rad, at the n positions; ISO signs.

    Raises
    ------
    ValueError
        Numbers of terms and coefficients differ.
    """
    return error_arrays(terms, theta, np.asarray(axes_mm) / travel_mm, angle_scale)


def monomial_field(terms: tuple[Monomial, ...], axes_mm: F2, travel_mm: F1) -> F3:
    """Deviation per unit of each coefficient of `monomial_errors`, first order: the design of math.md 5.5.

    Parameters
    ----------
    terms : tuple of Monomial
    axes_mm : array, shape (n, 3)
        Commanded positions from the machine's zero.
    travel_mm : array, shape (3,)

    Returns
    -------
    array, shape (n, 3, len(terms))
        mm per mm, or mm per rad for angles and squareness (``angle_scale`` 1); actual minus nominal, by rule G, i.e. (9) corrected.
    """
    form = machine(_ANY)
    out = np.empty((len(axes_mm), 3, len(terms)))
    for which, values in each_alone(terms, np.asarray(axes_mm) / travel_mm):
        times = which.stop - which.start
        where = np.tile(axes_mm, (times, 1))
        out[:, :, which] = deviation_mm(form, where, _motions(values, where)).reshape(times, len(axes_mm), 3).transpose(1, 2, 0)
    return out


_ANY = np.array([[0.0, 1.0]] * 3)
"""Strokes, which the deviation does not depend on."""


def _motions(errors: ErrorArrays, axes_mm: F2) -> F3:
    return iso_motions(errors.d, errors.e, (float(errors.s[0]), float(errors.s[1]), float(errors.s[2])), axes_mm)
