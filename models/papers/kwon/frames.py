"""Frames from three points and from all points, the position errors in each, and the scatter of repeated readings.

Source: Kwon 2004 (12)-(25) and 4.2 (Figs 13 and 14).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from abbe.models.arrays import F1, F2, F3
from abbe.models.papers.kwon.errors import CollinearPoints
from abbe.models.papers.kwon.kinematics import poses

FLAT = 1e-6
"""sin(theta) below which three points count as lying on a line."""

DATUM = (
    "Errors in the three-point frame depend on its datum: by construction e(P1) = 0, e(P2) = (e_x, 0, 0), e(P3) = (e_x, e_y, 0), so six "
    "errors are zero for any machine. The best-fit errors treat all points alike."
)

RIGID = 1e-6
"""Tolerance for unit length and right angles of the columns of a placement; a matrix typed with seven digits passes."""
COVERAGE = 2.0
"""The paper states repeatability as 2 standard deviations."""


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
        Note on the errors that the three-point frame cannot show.
    """

    three_point_mm: F2
    best_fit_mm: F2
    three_point_rms_mm: float
    best_fit_rms_mm: float
    datum: str = DATUM


def three_point_frame(points_mm: F2) -> F2:
    """Return the frame of three points, (12)-(21): origin P1, x towards P2, y in their plane, z = x × y.

    Parameters
    ----------
    points_mm : array, shape (3, 3)
        P1, P2, P3 as rows. P1P2 need not be perpendicular to P1P3.

    Returns
    -------
    array, shape (4, 4): homogeneous matrix from the frame to the coordinates of the points

    Raises
    ------
    CollinearPoints
        Two points coincide, or all lie on a line (sin theta below 1e-6).
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
    """Return the rigid motion (no mirroring) that brings nominal points closest to measured ones, by least squares.

    Parameters
    ----------
    nominal_mm, measured_mm : arrays, shape (n, 3)

    Returns
    -------
    array, shape (4, 4): measured = T nominal + errors

    Raises
    ------
    CollinearPoints
        The points lie on a line, so that the rotation about it is undetermined.
    """
    a, b = _pair(nominal_mm, measured_mm)
    ca, cb = a.mean(axis=0), b.mean(axis=0)
    spread = np.linalg.svd(a - ca, compute_uv=False)
    if a.shape[0] < 3 or spread[1] <= FLAT * spread[0]:
        raise CollinearPoints("best-fit frame: the nominal points lie on a line or coincide")
    rotation = nearest_rotation((b - cb).T @ (a - ca))
    return _homogeneous(rotation, cb - rotation @ ca)


def nearest_rotation(matrix: F2) -> F2:
    """Return the rotation (no mirroring) nearest to a (3, 3) matrix."""
    u, _, vt = np.linalg.svd(matrix)
    flip = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return np.asarray((u * flip) @ vt)


def checked_frame(name: str, frame: F2) -> F2:
    """Return a homogeneous matrix, shape (4, 4), as float64; check that it is a rigid motion.

    Raises
    ------
    ValueError
        The matrix has another shape, is not finite, scales, shears or mirrors (by more than 1e-6), or its last row is not 0 0 0 1.
    """
    t = np.asarray(frame, dtype=np.float64)
    if t.shape != (4, 4):
        raise ValueError(f"{name}: expected a homogeneous matrix of shape (4, 4), got shape {t.shape}")
    if not np.isfinite(t).all() or (t[3] != [0.0, 0.0, 0.0, 1.0]).any():
        raise ValueError(f"{name}: expected finite numbers with the last row 0 0 0 1")
    if np.abs(t[:3, :3].T @ t[:3, :3] - np.eye(3)).max() > RIGID:
        raise ValueError(f"{name}: the matrix scales or shears, but a placement only turns and shifts")
    if np.linalg.det(t[:3, :3]) < 0.0:
        raise ValueError(f"{name}: the matrix mirrors, but a placement only turns and shifts")
    return t


def into_frame(frame: F2, points_mm: F2) -> F2:
    """Return points in the coordinates of a frame, T^-1 P, (22), (23); shape (n, 3)."""
    result: F2 = (poses("points_mm", points_mm) - frame[:3, 3]) @ frame[:3, :3]
    return result


def from_frame(frame: F2, points_mm: F2) -> F2:
    """Return points of a frame in outer coordinates, T P, shape (n, 3)."""
    result: F2 = poses("points_mm", points_mm) @ frame[:3, :3].T + frame[:3, 3]
    return result


def three_point_errors(nominal3_mm: F2, measured3_mm: F2, nominal_mm: F2, measured_mm: F2) -> F2:
    """Return the errors e = T_m^-1 mP - T_d^-1 dP in the reference frame, (24) with T_mr_dr = I; shape (n, 3), mm.

    Parameters
    ----------
    nominal3_mm, measured3_mm : arrays, shape (3, 3)
        The datum points P1, P2, P3, designed and as measured.
    nominal_mm, measured_mm : arrays, shape (n, 3)
        Points to judge, in the coordinates of the parallel machine and of the CMM.

    Raises
    ------
    CollinearPoints
        The three datum points lie on a line.
    """
    nominal, measured = _pair(nominal_mm, measured_mm)
    return into_frame(three_point_frame(measured3_mm), measured) - into_frame(three_point_frame(nominal3_mm), nominal)


def best_fit_errors(nominal_mm: F2, measured_mm: F2) -> F2:
    """Return the errors after the best-fit rigid motion, along the axes of the nominal frame, shape (n, 3), mm."""
    nominal, measured = _pair(nominal_mm, measured_mm)
    return into_frame(best_fit_frame(nominal, measured), measured) - nominal


def position_errors(nominal3_mm: F2, measured3_mm: F2, nominal_mm: F2, measured_mm: F2) -> PositionErrors:
    """Return both kinds of position error; parameters as in `three_point_errors`."""
    three = three_point_errors(nominal3_mm, measured3_mm, nominal_mm, measured_mm)
    best = best_fit_errors(nominal_mm, measured_mm)
    return PositionErrors(three, best, rms(three), rms(best))


def rms(errors_mm: F2) -> float:
    """Return the root mean square length of error vectors, mm."""
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


@dataclass(frozen=True)
class Repeatability:
    """Scatter of repeated cycles.

    Attributes
    ----------
    sd_mm : array, shape (positions, 3)
        Standard deviation (n - 1) at every position, X, Y, Z.
    largest_2sd_mm : array, shape (3,)
        Two standard deviations at the worst position: the paper's "+-2 S at most".
    pooled_sd_mm : array, shape (3,)
        Root mean variance over the positions.
    dof : int
        Degrees of freedom of ``pooled_sd_mm``: positions x (cycles - 1).
    """

    sd_mm: F2
    largest_2sd_mm: F1
    pooled_sd_mm: F1
    dof: int


@dataclass(frozen=True, slots=True)
class ResidualStatistics:
    """Residuals of one error component, compared with the repeatability.

    Attributes
    ----------
    sd_mm, largest_mm : float
        Standard deviation with the residual degrees of freedom; largest absolute residual.
    ratio : float
        Residual variance over repeatability variance.
    p : float
        Probability of a larger ratio if the surface is complete; small means that scatter alone does not explain the residuals.
    """

    sd_mm: float
    largest_mm: float
    ratio: float
    p: float


def repeatability(readings_mm: F3) -> Repeatability:
    """Return the scatter of repeated visits.

    Parameters
    ----------
    readings_mm : array, shape (cycles, positions, 3)
        Measured positions, the same commands in every cycle; the paper made 6 cycles.

    Raises
    ------
    ValueError
        Fewer than 2 cycles, another shape, or a value that is not finite.
    """
    r = np.asarray(readings_mm, dtype=np.float64)
    if r.ndim != 3 or r.shape[0] < 2 or r.shape[1] < 1 or r.shape[2] != 3 or not np.isfinite(r).all():
        raise ValueError(f"repeatability: expected finite readings of shape (2 or more cycles, positions, 3), got {r.shape}")
    variance = r.var(axis=0, ddof=1)
    sd = np.sqrt(variance)
    return Repeatability(sd, COVERAGE * sd.max(axis=0), np.sqrt(variance.mean(axis=0)), r.shape[1] * (r.shape[0] - 1))


def residual_statistics(residual_mm: F1, df_res: int, repeat_sd_mm: float, repeat_dof: int) -> ResidualStatistics:
    """Test the lack of fit: whether the residuals of a surface exceed the repeatability.

    Parameters
    ----------
    residual_mm : array, shape (n,)
    df_res : int
        N - rank of the surface.
    repeat_sd_mm, repeat_dof
        Pooled standard deviation of the same component and its degrees of freedom.

    Raises
    ------
    ValueError
        Degrees of freedom are below 1, the repeatability is not positive and finite, or the residuals are empty or not finite.
    """
    if df_res < 1 or repeat_dof < 1 or not 0.0 < repeat_sd_mm < np.inf:
        raise ValueError("residual statistics: degrees of freedom must be 1 or more, and the repeatability positive and finite")
    residual = np.asarray(residual_mm, dtype=np.float64)
    if residual.ndim != 1 or residual.size == 0 or not np.isfinite(residual).all():
        raise ValueError(f"residual statistics: expected finite residuals of shape (n,), got shape {residual.shape} or a value not finite")
    variance = float((residual**2).sum()) / df_res
    ratio = variance / repeat_sd_mm**2
    return ResidualStatistics(
        float(np.sqrt(variance)), float(np.abs(residual).max()), ratio, float(scipy.special.fdtrc(df_res, repeat_dof, ratio))
    )
