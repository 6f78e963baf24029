"""Commands with their CMM points, and how such points depend on parameters and placement, in units of their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.geometry.rotation import rotation_matrix
from abbe.models.papers.kwon.frames import into_frame
from abbe.models.papers.kwon.geometry import Geometry, poses
from abbe.models.papers.kwon.kinematics import forward, jacobian
from abbe.models.papers.kwon.sensitivity import parameter_design

FRAME_NAMES = ("shift x", "shift y", "shift z", "turn a", "turn b", "turn c")


@dataclass(frozen=True)
class Readings:
    """Commands and measured points; repeated visits are repeated rows.

    Parameters
    ----------
    lambda_mm : array, shape (n, 3)
        Commands of the drives.
    measured_mm : array, shape (n, 3)
        Ball centres, CMM coordinates.
    u_point_mm : float
        Standard uncertainty of one coordinate of one measured point.
    u_lambda_mm : float
        Standard uncertainty with which a drive reaches its command, independent from row to row (repeatability of the stage).

    Raises
    ------
    ValueError
        Shapes differ, u_point_mm is not positive or u_lambda_mm is negative.
    """

    lambda_mm: F2
    measured_mm: F2
    u_point_mm: float
    u_lambda_mm: float = 0.0

    def __post_init__(self) -> None:
        """Check once."""
        lam, measured = poses("lambda_mm", self.lambda_mm), poses("measured_mm", self.measured_mm)
        if lam.shape != measured.shape:
            raise ValueError(f"readings: {lam.shape[0]} commands do not fit {measured.shape[0]} measured points")
        if not (0.0 < self.u_point_mm < np.inf and 0.0 <= self.u_lambda_mm < np.inf):
            raise ValueError("readings: u_point_mm must be positive and u_lambda_mm not negative")
        object.__setattr__(self, "lambda_mm", lam)
        object.__setattr__(self, "measured_mm", measured)


def point_design(geometry: Geometry, lambda_mm: F2, pivot_mm: F1 | None) -> F3:
    """Derivatives of the ball centre in base axes, shape (n, 3, 18), or (n, 3, 24) with shifts and turns about base axes through a pivot.

    Parameters
    ----------
    geometry : Geometry
    lambda_mm : array, shape (n, 3)
    pivot_mm : array, shape (3,), or None
        Base coordinates; None when the placement is known.
    """
    p = forward(geometry, lambda_mm)
    design = parameter_design(geometry, lambda_mm, p)
    if pivot_mm is None:
        return design
    rigid = np.zeros((p.shape[0], 3, len(FRAME_NAMES)))
    rigid[:, :, :3] = np.eye(3)
    for k in range(3):
        rigid[:, :, 3 + k] = np.cross(np.eye(3)[k], p - pivot_mm)
    return np.concatenate([design, rigid], axis=2)


def whitened(geometry: Geometry, readings: Readings, frame: F2, pivot_mm: F1 | None) -> tuple[F2, F1]:
    """Design (3n, 18 or 24) and misfit (3n,) of the readings in units of their standard uncertainty.

    Each point has the covariance u_point^2 I + u_lambda^2 J J', J = dP/dlambda.
    """
    p = forward(geometry, readings.lambda_mm)
    j = jacobian(geometry, readings.lambda_mm, p)
    covariance = readings.u_point_mm**2 * np.eye(3) + readings.u_lambda_mm**2 * (j @ np.swapaxes(j, 1, 2))
    root = np.linalg.cholesky(covariance)
    design = np.linalg.solve(root, point_design(geometry, readings.lambda_mm, pivot_mm))
    misfit = np.linalg.solve(root, (into_frame(frame, readings.measured_mm) - p)[..., None])
    return design.reshape(-1, design.shape[2]), misfit.ravel()


def moved_frame(frame: F2, move: F1, pivot_mm: F1) -> F2:
    """Placement after a shift and a turn (mm, rad, base axes) about a pivot in base coordinates, shape (4, 4)."""
    step = np.eye(4)
    step[:3, :3] = rotation_matrix(move[None, 3:])[0]
    step[:3, 3] = pivot_mm + move[:3] - step[:3, :3] @ pivot_mm
    return frame @ step
