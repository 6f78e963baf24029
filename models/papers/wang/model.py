"""Wang's machine FXYZ and its laser with a flat mirror: volumetric error, eq (9) to (11), and the exact reading (IV.A to C).

The paper writes delta_i(J) and alpha_i(J): i is the direction or rotation axis, J the moving axis; signs are those of ISO 230-1. X is the
datum of squareness. (9) and (11) are obtuse positive (Y line (-theta_xy, 1, 0), Z line (-theta_xz, -theta_yz, 1)), (12) and (13) acute
positive; this module is obtuse positive. Errata: (9) has -y alpha_x(X) in Pz, but +y is right, as in (11); (11) has -z theta_xy in Ex(Z),
but -z theta_xz is right.
"""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.functions.monomials import ErrorArrays, Monomial, error_arrays, individual_terms
from abbe.models.geometry.chain import deviation_mm, exact_deviation_mm
from abbe.models.machine import Machine
from abbe.models.paths import DIAGONALS
from abbe.models.solvers.step_diagonal import ORDER, checked_increments

CHAIN = "w-b-X-Y-Z-t"
"""FXYZ: the workpiece on the bed (F), then X, Y, Z towards the tool."""

ACUTE_FROM_OBTUSE = -1.0
"""Factor that converts the squareness of (9) and (11) to the squareness of (12) and (13)."""
_ANY = np.array([[0.0, 1.0]] * 3)
"""Any strokes; the deviation does not depend on them."""


def machine(stroke_mm: F2) -> Machine:
    """Return the nominal machine FXYZ with the functional point (the mirror) at the spindle reference; ``stroke_mm``: shape (3, 2)."""
    return Machine(CHAIN, np.asarray(stroke_mm, dtype=np.float64))


def iso_motions(d: F3, alpha: F3, theta: tuple[float, float, float], axes_mm: F2) -> F3:
    """Convert the paper's 21 errors to ISO error motions.

    Parameters
    ----------
    d : array, shape (n, 3, 3)
        delta_i(J) in mm: ``d[:, i, j]`` is the error in direction i of the motion along j, at the n positions.
    alpha : array, shape (n, 3, 3)
        alpha_i(J) in rad, indexed likewise.
    theta : (theta_xy, theta_xz, theta_yz)
        Squareness in rad, obtuse positive as in (9) and (11); multiply values of (12) or (13) by ACUTE_FROM_OBTUSE.
    axes_mm : array, shape (n, 3)
        Commanded positions.

    Returns
    -------
    array, shape (n, 3 axes X Y Z, 6)
        EX EY EZ (mm, squareness times travel included) and EA EB EC (rad), machine coordinates, ISO signs. With rule G they give (9)
        without its erratum.

    Raises
    ------
    ValueError
        Errors and positions differ in number.
    """
    p = np.asarray(axes_mm, dtype=np.float64)
    if d.shape != (p.shape[0], 3, 3) or alpha.shape != d.shape:
        raise ValueError(f"Wang errors: d {d.shape} and alpha {alpha.shape} must both have shape ({p.shape[0]}, 3, 3)")
    out = np.concatenate([d, alpha], axis=1).transpose(0, 2, 1).copy()
    out[:, 1, 0] -= theta[0] * p[:, 1]
    out[:, 2, 0] -= theta[1] * p[:, 2]
    out[:, 2, 1] -= theta[2] * p[:, 2]
    return out


def iso_squareness(theta_xy: float, theta_xz: float, theta_yz: float) -> dict[str, float]:
    """Return the obtuse-positive squareness of (9) and (11) under ISO names, rad: C0Y = +theta_xy, B0Z = -theta_xz, A0Z = +theta_yz."""
    return {"C0Y": theta_xy, "B0Z": -theta_xz, "A0Z": theta_yz}


def position_error_eq9(errors: ErrorArrays, axes_mm: F2) -> F2:
    """Return the position error (Px, Py, Pz) of (9), corrected, shape (n, 3), mm; it equals rule G for FXYZ and tool 0.

    Parameters
    ----------
    errors : ErrorArrays
        delta_i(J), alpha_i(J) at the n positions; squareness xy, xz, yz obtuse positive.
    axes_mm : array, shape (n, 3)
        Commanded positions x, y, z from the machine's zero.

    Raises
    ------
    ValueError
        Errors and positions differ in number.
    """
    return np.asarray(displacement_eq11(errors, axes_mm).sum(axis=2))


def position_error_eq9_printed(errors: ErrorArrays, axes_mm: F2) -> F2:
    """Evaluate (9) as printed: the roll of X enters Pz with the wrong sign; for comparison only."""
    out = position_error_eq9(errors, axes_mm)
    out[:, 2] -= 2.0 * axes_mm[:, 1] * errors.e[:, 0, 0]
    return out


def displacement_eq11(errors: ErrorArrays, axes_mm: F2) -> F3:
    """Return the displacement errors E_i(J) of (11), corrected, shape (n, 3 directions i, 3 axes J), mm.

    Parameters are those of `position_error_eq9`. For positions on one axis the lever arms vanish, and the translational part remains, as in
    a single-axis measurement.

    Raises
    ------
    ValueError
        As in `position_error_eq9`.
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
    """Evaluate (11) as printed: Ex(Z) has theta_xy in place of theta_xz; for comparison only."""
    out = displacement_eq11(errors, axes_mm)
    out[:, 0, 2] += axes_mm[:, 2] * (errors.s[1] - errors.s[0])
    return out


def exact_positions_mm(errors: ErrorArrays, axes_mm: F2) -> F2:
    """Return the position error of the mirror (actual minus nominal) with full rotations Rz Ry Rx, shape (n, 3), mm."""
    return exact_deviation_mm(machine(_ANY), axes_mm, _motions(errors, axes_mm), rotation="zyx")


def monomial_errors(terms: tuple[Monomial, ...], theta: F1, axes_mm: F2, travel_mm: F1, angle_scale: float = 1.0) -> ErrorArrays:
    """Evaluate the 21 errors of a machine given by coefficients of u = position / travel, as in the reference vectors.

    Parameters
    ----------
    terms, theta : tuple of Monomial, array of shape (len(terms),)
        Coefficients: mm for delta, rad / ``angle_scale`` for alpha and squareness, obtuse positive as in (9) and (11).
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
    """Return the first-order deviation per unit of each coefficient of `monomial_errors`.

    Parameters
    ----------
    terms : tuple of Monomial
    axes_mm : array, shape (n, 3)
        Commanded positions from the machine's zero.
    travel_mm : array, shape (3,)

    Returns
    -------
    array, shape (n, 3, len(terms))
        mm per mm, or mm per rad for angles and squareness; actual minus nominal, by rule G, i.e. (9) corrected.
    """
    form = machine(_ANY)
    out = np.empty((len(axes_mm), 3, len(terms)))
    for which, values in individual_terms(terms, np.asarray(axes_mm) / travel_mm):
        times = which.stop - which.start
        positions_mm = np.tile(axes_mm, (times, 1))
        out[:, :, which] = (
            deviation_mm(form, positions_mm, _motions(values, positions_mm)).reshape(times, len(axes_mm), 3).transpose(1, 2, 0)
        )
    return out


def _motions(errors: ErrorArrays, axes_mm: F2) -> F3:
    return iso_motions(errors.d, errors.e, (float(errors.s[0]), float(errors.s[1]), float(errors.s[2])), axes_mm)


def diagonal_beam(inc_mm: F1, diagonal: str) -> F1:
    """Return the unit vector along a body diagonal for increments X, Y, Z, eq (3), machine coordinates, shape (3,).

    Raises
    ------
    ValueError
        ``diagonal`` is none of ppp, npp, pnp, ppn, or the increments are not three positive numbers.
    """
    if diagonal not in DIAGONALS:
        raise ValueError(f"diagonal {diagonal!r}: must be one of {', '.join(DIAGONALS)}")
    v = np.array(DIAGONALS[diagonal], dtype=np.float64) * checked_increments(inc_mm)
    return np.asarray(v / np.linalg.norm(v))


def tilt_axes(beam: F1) -> F2:
    """Return two unit vectors across a beam n that is not vertical, shape (2, 3): e1 along n × z, and e2 = n × e1.

    Raises
    ------
    ValueError
        The beam is vertical (n × z is zero).
    """
    first = np.cross(beam, np.array([0.0, 0.0, 1.0]))
    size = float(np.linalg.norm(first))
    if size < 1e-9:
        raise ValueError("mirror tilt: the beam is vertical, so n × z defines no direction across it")
    first = first / size
    return np.stack([first, np.cross(beam, first)])


def mirror_normal(beam: F1, tilt_rad: F1) -> F1:
    """Return the normal of a tilted mirror, n + tan(t1) e1 + tan(t2) e2, not of unit length; the paper (IV.C) has no equation for it.

    Parameters
    ----------
    beam : array, shape (3,)
        Unit vector n of the nominal beam, machine coordinates, not vertical.
    tilt_rad : array, shape (2,)
        Tilt towards each of the two directions of `tilt_axes`; a positive angle leans the NORMAL towards the direction.

    Returns
    -------
    array, shape (3,), no unit.

    Raises
    ------
    ValueError
        The beam is vertical.
    """
    return np.asarray(beam + np.tan(np.asarray(tilt_rad, dtype=np.float64)) @ tilt_axes(beam))


def reading_mm(points_mm: F2, mirror: F1, beam: F1) -> F1:
    """Return the exact distance along the beam l to the plane of the mirror m, m.P / (m.l), relative to the origin, mm, shape (n,).

    Parameters
    ----------
    points_mm : array, shape (n, 3)
        Actual position of a point of the mirror. Pass differences instead of large coordinates, so that no digits are lost.
    mirror, beam : array, shape (3,)
        Normal of the mirror (any length) and unit vector of the beam.

    Raises
    ------
    ValueError
        The mirror is parallel to the beam (m.l = 0).
    """
    return np.asarray(points_mm @ mirror / _facing(mirror, beam))


def step_readings_mm(path_mm: F2, deviation_mm: F2, beam: F1, mirror: F1) -> F1:
    """Return the displayed deviation of a diagonal test: reading since the first record minus nominal displacement, shape (n,).

    The result is exact: `reading_mm` of the moved mirror less the nominal displacement, (4) and (5) for a square mirror. Both parts are
    computed so that the rounding error is relative to the deviation, not to the displacement.

    Parameters
    ----------
    path_mm, deviation_mm : array, shape (n, 3)
        Commanded positions and the machine's deviations there (actual minus nominal), machine coordinates; the first record is the zero.
    beam, mirror : array, shape (3,)
        Unit vector of the beam; normal of the mirror, of any length (`mirror_normal`).

    Returns
    -------
    array, shape (n,), mm, positive = farther along the beam than commanded; the first is 0.

    Raises
    ------
    ValueError
        The mirror is parallel to the beam (m.l = 0).
    """
    along = _facing(mirror, beam)
    aside = (mirror - beam * (along / float(beam @ beam))) / along  # exactly zero for a square mirror
    moved = path_mm - path_mm[0]
    return np.asarray(moved @ aside + (deviation_mm - deviation_mm[0]) @ (mirror / along))


def tilt_bias_eq7(inc_mm: F1, tilt: dict[str, F1]) -> F2:
    """Return the bias that tilted mirrors cause in each interval of (7), shape (3 directions i, 3 axes a), mm per step.

    The bias is linear in position: false scale and squareness errors of the size of the tilt.

    Parameters
    ----------
    inc_mm : array, shape (3,)
        Increments X, Y, Z.
    tilt : dict of arrays (3,)
        For each diagonal ppp, npp, pnp, ppn, the vector t across the beam in the mirror's normal m = n + t.
    """
    r = float(np.linalg.norm(inc_mm))
    p = tilt["ppp"]
    return np.stack([(p - tilt[ORDER[i + 1]]) * inc_mm * r / (2 * inc_mm[i]) for i in range(3)])


def tilt_closure_mm(inc_mm: F1, tilt: dict[str, F1]) -> F1:
    """Return the contribution of tilted mirrors to the closure ppp - npp - pnp - ppn per axis, mm, shape (3,); it reveals the tilts."""
    return np.asarray(inc_mm * (tilt["ppp"] - tilt["npp"] - tilt["pnp"] - tilt["ppn"]))


def cosine_error(misalignment_rad: float) -> float:
    """Return the relative error 1 / (m.l) - 1 of a beam misaligned to a square mirror: second order, 0.5 ppm at 1 mrad."""
    c = np.cos(misalignment_rad)
    if c <= 0:
        raise ValueError(f"beam: the misalignment of {misalignment_rad} rad must be below a right angle")
    return float(2.0 * np.sin(0.5 * misalignment_rad) ** 2 / c)


def projection_factors(inc_mm: F1) -> F1:
    """Return the share of each axis' displacement that a diagonal shows, X/R, Y/R, Z/R, shape (3,): 1/√3 = 0.577 for a cube.

    Erratum: Wang IV.A prints "1/√3²".

    Raises
    ------
    ValueError
        Increments are not three positive numbers.
    """
    inc = checked_increments(inc_mm)
    return np.asarray(inc / np.linalg.norm(inc))


def _facing(mirror: F1, beam: F1) -> float:
    """Return m.l; ValueError if the mirror is parallel to the beam or has no normal."""
    along = float(mirror @ beam)
    if not abs(along) > 1e-12 * float(np.linalg.norm(mirror)):
        raise ValueError("laser: the mirror is parallel to the beam (m.l = 0)")
    return along
