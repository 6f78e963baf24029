"""Yang and Kim's complete volumetric error model with all 21 errors, eq (1), as printed (math.md 4.1).

Same as rule G for the chain `abbe.models.notation.yang.CHAIN`; written out here term by term so that the paper can be read next to it.
"""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.functions.monomials import ErrorArrays, Monomial, each_alone, error_arrays
from abbe.models.geometry.chain import deviation_mm, exact_deviation_mm
from abbe.models.notation.yang import YangErrors, iso_motions, machine, workpiece_mm

ANGLE_MM = 500.0
"""The vectors state coefficients of angles and squareness times this length, so that all coefficients are lengths of like size."""


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
    n, where, tool = errors.d.shape[0], np.shape(slide_mm), np.shape(tool_mm)
    if where != (n, 3) or tool != (3,):
        raise ValueError(f"eq (1): errors of {n} positions do not fit positions of shape {where}, or tool {tool} is not (3,)")
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
    """The same machine without linearisation: full rotations Rz Ry Rx, or (``small_angles``) the paper's matrices multiplied out exactly.

    Parameters, result: as `delta_eq1`.
    """
    form = machine(np.array([[0.0, 1.0]] * 3), tool_mm)
    return exact_deviation_mm(form, workpiece_mm(slide_mm), iso_motions(errors, slide_mm), rotation="small" if small_angles else "zyx")


def monomial_errors(terms: tuple[Monomial, ...], theta: F1, slide_mm: F2, travel_mm: F1) -> YangErrors:
    """The 21 errors of a machine stated by coefficients of u = scale / travel, the form of the vectors (math.md 4.6).

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
    for which, values in each_alone(terms, slide / travel_mm, 1.0 / ANGLE_MM):
        times = which.stop - which.start
        where = np.tile(slide, (times, 1))
        seen = deviation_mm(form, np.tile(points_mm, (times, 1)), iso_motions(_as_errors(values), where))
        out[:, :, which] = seen.reshape(times, len(slide), 3).transpose(1, 2, 0)
    return out


def _as_errors(a: ErrorArrays) -> YangErrors:
    return YangErrors(a.d, a.e, float(a.s[0]), float(a.s[1]), float(a.s[2]))
