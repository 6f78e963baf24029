"""Wang's machine FXYZ and its laser with a flat mirror: volumetric error, eq (9) to (11), and the exact reading (IV.A to C).

Names and signs of the paper (004; math.md 1, 3, 5) in ISO 230-1 motions: delta_i(J) and alpha_i(J), i the direction or rotation axis, J
the moving axis; signs are ISO's. X is the datum of squareness, but the sign turns within the paper: equations (9) and (11) are obtuse
positive (Y line (-theta_xy, 1, 0), Z line (-theta_xz, -theta_yz, 1)), equations (12) and (13) acute positive. Obtuse positive here.

Two slips of the paper: (9) has -y alpha_x(X) in Pz, +y is right (its own (11) has it); (11) has -z theta_xy in Ex(Z), -z theta_xz is right.
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
"""FXYZ: foundation with the workpiece, then X, Y, Z towards the tool."""

ACUTE_FROM_OBTUSE = -1.0
"""Squareness of (12) and (13) = this times that of (9) and (11)."""
_ANY = np.array([[0.0, 1.0]] * 3)
"""Strokes, which the deviation does not depend on."""


def machine(stroke_mm: F2) -> Machine:
    """FXYZ with the functional point (the laser's mirror) at the spindle reference, tool (0, 0, 0); ``stroke_mm``: shape (3, 2)."""
    return Machine(CHAIN, np.asarray(stroke_mm, dtype=np.float64))


def iso_motions(d: F3, alpha: F3, theta: tuple[float, float, float], axes_mm: F2) -> F3:
    """Error motions of rule G from the paper's 21 errors.

    Parameters
    ----------
    d : array, shape (n, 3, 3)
        delta_i(J) in mm: ``d[:, i, j]`` in direction i of the motion along j, at the n positions.
    alpha : array, shape (n, 3, 3)
        alpha_i(J) in rad, likewise.
    theta : (theta_xy, theta_xz, theta_yz)
        Squareness in rad, obtuse positive as in (9) and (11); for values of (12) or (13) multiply by ACUTE_FROM_OBTUSE.
    axes_mm : array, shape (n, 3)
        Commanded positions.

    Returns
    -------
    array, shape (n, 3 axes X Y Z, 6)
        EX EY EZ (mm, squareness times travel included) and EA EB EC (rad), machine coordinates, ISO signs: as printed. Rule G on them gives
        eq (9) without its erratum (Pz: +y alpha_x(X); math.md 1, 3).

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
    """Obtuse-positive squareness of (9) and (11) under ISO names, rad: C0Y = +theta_xy, B0Z = -theta_xz, A0Z = +theta_yz (math.md 1)."""
    return {"C0Y": theta_xy, "B0Z": -theta_xz, "A0Z": theta_yz}


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
    """Position error of the mirror with full rotations Rz Ry Rx: actual minus nominal, shape (n, 3), mm."""
    return exact_deviation_mm(machine(_ANY), axes_mm, _motions(errors, axes_mm), rotation="zyx")


def monomial_errors(terms: tuple[Monomial, ...], theta: F1, axes_mm: F2, travel_mm: F1, angle_scale: float = 1.0) -> ErrorArrays:
    """The 21 errors of a machine stated by coefficients of u = position / travel, the form of the reference vectors (math.md 4.6, 5.5).

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
    """Unit vector along a body diagonal for increments X, Y, Z, shape (3,), machine coordinates, eq (3) (math.md 5.1, 3 row W (3)).

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
    """Two unit vectors across a beam that is not vertical, shape (2, 3): n × z, and n × that.

    Raises
    ------
    ValueError
        The beam is vertical (n × z is zero).
    """
    first = np.cross(beam, np.array([0.0, 0.0, 1.0]))
    size = float(np.linalg.norm(first))
    if size < 1e-9:
        raise ValueError("mirror tilt: the beam is vertical, n × z names no direction across it")
    first = first / size
    return np.stack([first, np.cross(beam, first)])


def mirror_normal(beam: F1, tilt_rad: F1) -> F1:
    """Normal of a tilted mirror, n + tan(t1) e1 + tan(t2) e2, not of unit length (math.md 5.4; in the paper's IV.C words only).

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
        As `tilt_axes`.
    """
    return np.asarray(beam + np.tan(np.asarray(tilt_rad, dtype=np.float64)) @ tilt_axes(beam))


def reading_mm(points_mm: F2, mirror: F1, beam: F1) -> F1:
    """Exact distance along the beam to the plane of the mirror, m.(P - O) / (m.l), relative to the origin O = 0, shape (n,).

    Parameters
    ----------
    points_mm : array, shape (n, 3)
        Where a point of the mirror really is; with large coordinates pass differences, so that no digits are lost.
    mirror, beam : array, shape (3,)
        Normal of the mirror (any length) and unit vector of the beam.

    Raises
    ------
    ValueError
        The mirror stands along the beam (m.l = 0).
    """
    return np.asarray(points_mm @ mirror / _facing(mirror, beam))


def step_readings_mm(path_mm: F2, deviation_mm: F2, beam: F1, mirror: F1) -> F1:
    """Displayed deviation of a diagonal test: reading since the first record minus nominal displacement along the diagonal, shape (n,).

    Nominal and erroneous part are computed separately, so that the result is rounded like a micrometre and not like a metre. Exact:
    `reading_mm` of the moved mirror less the nominal displacement (math.md 5.4; eq (4) and (5) for a square mirror).

    Parameters
    ----------
    path_mm, deviation_mm : array, shape (n, 3)
        Commanded positions and the machine's deviation there (actual minus nominal), mm, machine coordinates; the first record is the zero.
    beam, mirror : array, shape (3,)
        Unit vector of the beam; normal of the mirror, of any length (`mirror_normal`).

    Returns
    -------
    array, shape (n,), mm, positive = farther along the beam than commanded; the first is 0.

    Raises
    ------
    ValueError
        The mirror stands along the beam (m.l = 0).
    """
    along = _facing(mirror, beam)
    aside = (mirror - beam * (along / float(beam @ beam))) / along  # zero for a square mirror, to the last digit
    moved = path_mm - path_mm[0]
    return np.asarray(moved @ aside + (deviation_mm - deviation_mm[0]) @ (mirror / along))


def tilt_bias_eq7(inc_mm: F1, tilt: dict[str, F1]) -> F2:
    """What tilted mirrors add to each interval of eq (7), shape (3 directions i, 3 axes a), mm per step (math.md 5.4).

    Linear in position, i.e. false scale and squareness of the size of the tilt.

    Parameters
    ----------
    inc_mm : array, shape (3,)
        Increments X, Y, Z.
    tilt : dict of arrays (3,)
        Of each diagonal ppp, npp, pnp, ppn: the vector t, across the beam, of the mirror's normal m = n + t.
    """
    r = float(np.linalg.norm(inc_mm))
    p = tilt["ppp"]
    return np.stack([(p - tilt[ORDER[i + 1]]) * inc_mm * r / (2 * inc_mm[i]) for i in range(3)])


def tilt_closure_mm(inc_mm: F1, tilt: dict[str, F1]) -> F1:
    """What tilted mirrors add to ppp - npp - pnp - ppn per axis, shape (3,): the trace by which the closure test finds them."""
    return np.asarray(inc_mm * (tilt["ppp"] - tilt["npp"] - tilt["pnp"] - tilt["ppn"]))


def cosine_error(misalignment_rad: float) -> float:
    """Relative excess 1 / (m.l) - 1 of a beam misaligned to a square mirror: second order, 0.5 ppm at 1 mrad."""
    c = np.cos(misalignment_rad)
    if c <= 0:
        raise ValueError(f"beam: misalignment {misalignment_rad} rad must stay below a right angle")
    return float(2.0 * np.sin(0.5 * misalignment_rad) ** 2 / c)


def projection_factors(inc_mm: F1) -> F1:
    """Share of an axis' displacement that a diagonal shows, X/R Y/R Z/R, shape (3,): 1/sqrt(3) for a cube (the paper's 0.577).

    Source: Wang IV.A, printed as "1/√3²" (erratum, math.md 3).

    Raises
    ------
    ValueError
        Increments are not three positive numbers.
    """
    inc = checked_increments(inc_mm)
    return np.asarray(inc / np.linalg.norm(inc))


def _facing(mirror: F1, beam: F1) -> float:
    """m.l; ValueError where the beam meets the mirror edge-on, or the mirror has no normal."""
    along = float(mirror @ beam)
    if not abs(along) > 1e-12 * float(np.linalg.norm(mirror)):
        raise ValueError("laser: the mirror stands along the beam (m.l = 0)")
    return along
