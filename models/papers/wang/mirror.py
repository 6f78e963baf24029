"""The laser with a flat mirror: exact reading, mirror tilt, beam misalignment, projection factor (Wang IV.A to IV.C; math.md 5.4)."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.paths.lines import DIAGONALS
from abbe.models.solvers.step_diagonal import ORDER, checked_increments


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

    Nominal and erroneous part are read apart, so that the result has the digits of a micrometre and not those of a metre. Exact:
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
    """m.l, refused where the mirror shows the beam its edge (or has no normal)."""
    along = float(mirror @ beam)
    if not abs(along) > 1e-12 * float(np.linalg.norm(mirror)):
        raise ValueError("laser: the mirror stands along the beam (m.l = 0)")
    return along
