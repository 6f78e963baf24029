"""Yang and Kim's six-parameter model and its fit, eq (2) and (9), in both readings of z (math.md 4.2).

Eq (2), (4), (8), (9) take the slide's z for a workpiece coordinate; by their own eq (1) the workpiece coordinate is -z. With readings of a
real machine the printed matrix returns dzz, Sxz and Syz with the wrong sign. The default here is the physical reading.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import Literal

import numpy as np
import scipy

from abbe.models.arrays import F1, F2

RADIUS_TOLERANCE = 0.01
"""A larger share cannot be lost motion or polyline: radius or origin belong to other points, and all parameters scale with it."""
ZConvention = Literal["slide", "workpiece"]
PRINTED_WARNING = (
    "z was taken for a workpiece coordinate, as eq (2), (4), (8) and (9) are printed: if it is the position of the Z slide, "
    "dzz, Sxz and Syz come out with the wrong sign (math.md 4.2)"
)


@dataclass(frozen=True, slots=True)
class SixParameters:
    """dxx, dyy, dzz: linear positioning error per travel (mm/mm); sxy, sxz, syz: squareness (rad), signs of the paper."""

    dxx: float
    dyy: float
    dzz: float
    sxy: float
    sxz: float
    syz: float

    def array(self) -> F1:
        """The six values in the paper's order, shape (6,)."""
        return np.array(astuple(self))


@dataclass(frozen=True, slots=True)
class SixFit:
    """Solution of eq (9), the covariance per unit variance of a reading (times your noise in mm²), and what the reader must know."""

    parameters: SixParameters
    covariance_per_mm2: F2
    residual_mm: F1
    warnings: tuple[str, ...]


def delta_eq2(p: SixParameters, slide_mm: F2) -> F2:
    """Error of the six-parameter model, eq (2): shape (n, 3), mm; ``slide_mm``: scales x, y, z (z of the cross slide)."""
    x, y, z = np.asarray(slide_mm, dtype=np.float64).T
    return np.stack([p.dxx * x - y * p.sxy, p.dyy * y, -p.dzz * z - x * p.sxz - y * p.syz], axis=1)


def matrix_eq9_printed(points_mm: F2, origin_mm: F1) -> F2:
    """Matrix A of eq (9) as printed, shape (n, 6): z is read as a workpiece coordinate (erratum, math.md 3 and 4.2), mm²."""
    u, v, s = (np.asarray(points_mm, dtype=np.float64) - origin_mm).T
    return np.stack([u * u, v * v, -s * s, -u * v, -u * s, -v * s], axis=1)


def matrix_eq9(points_mm: F2, origin_mm: F1) -> F2:
    """Matrix A of eq (9) for scale readings, the workpiece coordinate being -z (math.md 4.2, physical reading), shape (n, 6), mm²."""
    u, v, s = (np.asarray(points_mm, dtype=np.float64) - origin_mm).T
    return np.stack([u * u, v * v, s * s, -u * v, u * s, v * s], axis=1)


def matrix_of(points_mm: F2, origin_mm: F1, z_convention: ZConvention) -> F2:
    """`matrix_eq9` for ``"slide"``, `matrix_eq9_printed` for ``"workpiece"``.

    Raises
    ------
    ValueError
        ``z_convention`` is neither.
    """
    if z_convention not in ("slide", "workpiece"):
        raise ValueError(f"z_convention {z_convention!r}: must be 'slide' or 'workpiece'")
    return matrix_eq9(points_mm, origin_mm) if z_convention == "slide" else matrix_eq9_printed(points_mm, origin_mm)


def fit_eq9(points_mm: F2, origin_mm: F1, delta_r_mm: F1, radius_mm: float, *, z_convention: ZConvention = "slide") -> SixFit:
    """Six parameters from one ball-bar test by least squares, eq (9), perfect mounting assumed.

    A mounting error of 10 µm fakes about 100 µrad here (math.md 4.5): for measured data use `abbe.models.solvers.helix.fit_helix`, which
    takes cup offset and bar length as unknowns.

    Parameters
    ----------
    points_mm, origin_mm : array, shape (n, 3) and (3,)
        Commanded positions and the centre, scales or workpiece coordinates as ``z_convention`` says.
    delta_r_mm : array, shape (n,)
        Bar length minus radius.
    radius_mm : float
        Nominal bar length: the distance of the points from the origin, to 1 %.
    z_convention : "slide" | "workpiece"
        ``slide``: z is the position of the Z slide (physical). ``workpiece``: as printed, with a warning in the result.

    Returns
    -------
    SixFit
        Parameters (mm/mm and rad, the paper's signs: obtuse positive), covariance per mm² of reading variance, residual (mm), warnings.
        Erratum: as printed dzz, Sxz and Syz of a real machine have the wrong sign (math.md 3 row Y (9), 4.2).

    Raises
    ------
    ValueError
        Unknown ``z_convention``, or fewer than six readings, or they do not determine the six parameters, or the radius is not positive or
        more than 1 % off the points' distance from the origin.
    """
    if not 0 < radius_mm < np.inf:
        raise ValueError(f"eq (9): radius {radius_mm} mm must be positive")
    a = matrix_of(points_mm, origin_mm, z_convention) / radius_mm
    if len(delta_r_mm) < 6 or a.shape[0] != len(delta_r_mm):
        raise ValueError(f"eq (9): {len(delta_r_mm)} readings for {a.shape[0]} points, six parameters")
    away = np.linalg.norm(np.asarray(points_mm, dtype=np.float64) - origin_mm, axis=1)
    worst = float(away[int(np.argmax(np.abs(away - radius_mm)))])
    if not abs(worst - radius_mm) <= RADIUS_TOLERANCE * radius_mm:
        raise ValueError(f"eq (9): a point lies {worst:g} mm from the origin, the radius is {radius_mm:g} mm")
    scale = np.linalg.norm(a, axis=0)
    if not (scale > 0).all():
        raise ValueError("eq (9): the points do not leave a plane or line through the centre, some parameters are not seen")
    q, r = scipy.linalg.qr(a / scale, mode="economic")
    if np.abs(np.diag(r)).min() < 1e-9:
        raise ValueError("eq (9): the points do not determine the six parameters")
    x = scipy.linalg.solve_triangular(r, q.T @ delta_r_mm) / scale
    inverse = scipy.linalg.solve_triangular(r, np.eye(6)) / scale[:, None]
    warnings = (PRINTED_WARNING,) if z_convention == "workpiece" else ()
    return SixFit(SixParameters(*(float(v) for v in x)), inverse @ inverse.T, np.asarray(delta_r_mm - a @ x), warnings)
