"""Frames from three points and from all points, and the position errors that each of them gives. Source: Kwon 2004 (12)-(25), math.md 6."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.papers.kwon.errors import CollinearPoints
from abbe.models.papers.kwon.geometry import poses

FLAT = 1e-6
"""sin(theta) below which three points count as lying on a line."""

DATUM = (
    "Errors in the three-point frame depend on its datum: by construction e(P1) = 0, e(P2) = (e_x, 0, 0), e(P3) = (e_x, e_y, 0): six "
    "errors are zero whatever the machine does. The best-fit errors do not single out any point."
)

RIGID = 1e-6
"""How far the columns of a placement may be from unit length and right angles: a matrix typed with seven digits passes."""


@dataclass(frozen=True)
class PositionErrors:
    """Position errors (measured - nominal) of the same points in both frames.

    Attributes
    ----------
    three_point_mm, best_fit_mm : array, shape (n, 3)
        Components along the axes of the reference frame (three-point) and of the nominal frame (best fit).
    three_point_rms_mm, best_fit_rms_mm : float
        Root mean square of the error vectors' lengths.
    datum : str
        What the three-point errors cannot show.
    """

    three_point_mm: F2
    best_fit_mm: F2
    three_point_rms_mm: float
    best_fit_rms_mm: float
    datum: str = DATUM


def three_point_frame(points_mm: F2) -> F2:
    """Frame of three points: origin P1, x towards P2, y in their plane, z = x cross y; (12)-(17) and (18)-(21) with columns [x y z P1].

    Parameters
    ----------
    points_mm : array, shape (3, 3)
        P1, P2, P3 as rows; the designed ones have P1P2 perpendicular to P1P3, measured ones need not.

    Returns
    -------
    array, shape (4, 4): homogeneous matrix from the frame to the coordinates of the points

    Raises
    ------
    CollinearPoints
        Two of them coincide or all lie on a line (sin theta below 1e-6).
    """
    p = poses("points_mm", points_mm)
    if p.shape[0] != 3:
        raise ValueError(f"three-point frame: expected 3 points, got {p.shape[0]}")
    to2, to3 = p[1] - p[0], p[2] - p[0]
    l12, l13, l23 = (float(np.linalg.norm(v)) for v in (to2, to3, to3 - to2))
    if min(l12, l13, l23) == 0.0 or float(np.linalg.norm(np.cross(to2, to3))) < FLAT * l12 * l13:
        raise CollinearPoints(f"three-point frame: the points lie on a line or coincide (distances {l12:.6g}, {l13:.6g}, {l23:.6g} mm)")
    theta = np.arccos(np.clip((l12**2 + l13**2 - l23**2) / (2.0 * l12 * l13), -1.0, 1.0))
    x = to2 / l12
    y = (to3 - l13 * np.cos(theta) * x) / (l13 * np.sin(theta))
    return _homogeneous(np.stack([x, y, np.cross(x, y)], axis=1), p[0])


def best_fit_frame(nominal_mm: F2, measured_mm: F2) -> F2:
    """Rigid motion (rotation and shift, no mirror) that brings nominal points closest to measured ones, least squares.

    Parameters
    ----------
    nominal_mm, measured_mm : arrays, shape (n, 3)

    Returns
    -------
    array, shape (4, 4): measured = T nominal + errors

    Raises
    ------
    CollinearPoints
        The points lie on a line, so that the turn about it is undetermined.
    """
    a, b = _pair(nominal_mm, measured_mm)
    ca, cb = a.mean(axis=0), b.mean(axis=0)
    spread = np.linalg.svd(a - ca, compute_uv=False)
    if a.shape[0] < 3 or spread[1] <= FLAT * spread[0]:
        raise CollinearPoints("best-fit frame: the nominal points lie on a line or coincide")
    rotation = nearest_rotation((b - cb).T @ (a - ca))
    return _homogeneous(rotation, cb - rotation @ ca)


def nearest_rotation(matrix: F2) -> F2:
    """Rotation nearest to a (3, 3) matrix (largest trace of the product), mirror excluded."""
    u, _, vt = np.linalg.svd(matrix)
    flip = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return np.asarray((u * flip) @ vt)


def checked_frame(name: str, frame: F2) -> F2:
    """Homogeneous matrix of a rigid motion, shape (4, 4), float64.

    Raises
    ------
    ValueError
        It has another shape, is not finite, scales, shears or mirrors (by more than 1e-6), or its last row is not 0 0 0 1.
    """
    t = np.asarray(frame, dtype=np.float64)
    if t.shape != (4, 4):
        raise ValueError(f"{name}: expected a homogeneous matrix of shape (4, 4), got shape {t.shape}")
    if not np.isfinite(t).all() or (t[3] != [0.0, 0.0, 0.0, 1.0]).any():
        raise ValueError(f"{name}: expected finite numbers with the last row 0 0 0 1")
    if np.abs(t[:3, :3].T @ t[:3, :3] - np.eye(3)).max() > RIGID:
        raise ValueError(f"{name}: it scales or shears, a placement only turns and shifts")
    if np.linalg.det(t[:3, :3]) < 0.0:
        raise ValueError(f"{name}: it mirrors, a placement only turns and shifts")
    return t


def into_frame(frame: F2, points_mm: F2) -> F2:
    """T^-1 P: points in the coordinates of a frame, (22), (23); shape (n, 3)."""
    result: F2 = (poses("points_mm", points_mm) - frame[:3, 3]) @ frame[:3, :3]
    return result


def from_frame(frame: F2, points_mm: F2) -> F2:
    """T P: points of a frame in outer coordinates, shape (n, 3)."""
    result: F2 = poses("points_mm", points_mm) @ frame[:3, :3].T + frame[:3, 3]
    return result


def three_point_errors(nominal3_mm: F2, measured3_mm: F2, nominal_mm: F2, measured_mm: F2) -> F2:
    """Errors e = T_m^-1 mP - T_d^-1 dP in the reference frame, (24) with T_mr_dr = I (math.md 3, K (24)); shape (n, 3), mm.

    Parameters
    ----------
    nominal3_mm, measured3_mm : arrays, shape (3, 3)
        The datum points P1, P2, P3, designed and as measured.
    nominal_mm, measured_mm : arrays, shape (n, 3)
        Points to judge, in the coordinates of the parallel machine and of the CMM.

    Raises
    ------
    CollinearPoints
    """
    nominal, measured = _pair(nominal_mm, measured_mm)
    return into_frame(three_point_frame(measured3_mm), measured) - into_frame(three_point_frame(nominal3_mm), nominal)


def best_fit_errors(nominal_mm: F2, measured_mm: F2) -> F2:
    """Errors after the best-fit rigid motion, along the axes of the nominal frame, shape (n, 3), mm."""
    nominal, measured = _pair(nominal_mm, measured_mm)
    return into_frame(best_fit_frame(nominal, measured), measured) - nominal


def position_errors(nominal3_mm: F2, measured3_mm: F2, nominal_mm: F2, measured_mm: F2) -> PositionErrors:
    """Both kinds of position error with the statement what the datum hides; parameters as `three_point_errors`."""
    three = three_point_errors(nominal3_mm, measured3_mm, nominal_mm, measured_mm)
    best = best_fit_errors(nominal_mm, measured_mm)
    return PositionErrors(three, best, rms(three), rms(best))


def rms(errors_mm: F2) -> float:
    """Root mean square length of error vectors, mm."""
    return float(np.sqrt((errors_mm**2).sum(axis=1).mean()))


def _pair(nominal_mm: F2, measured_mm: F2) -> tuple[F2, F2]:
    a, b = poses("nominal_mm", nominal_mm), poses("measured_mm", measured_mm)
    if a.shape != b.shape:
        raise ValueError(f"frames: {a.shape[0]} nominal points do not fit {b.shape[0]} measured ones")
    return a, b


def _homogeneous(rotation: F2, origin: F1) -> F2:
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = rotation, origin
    return frame
