"""Figures of a deviation field: volume grid, best-fit rigid motion, rms and maximum, body diagonals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2


def volume_grid(box_mm: F2, nodes: int) -> F2:
    """Product grid over a box (shape (3, 2)), x slowest, shape (nodes**3, 3)."""
    axes = [np.linspace(lo, hi, nodes) for lo, hi in box_mm]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def rigid_design(points_mm: F2) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Derivative of a small rigid motion (3 translations, 3 rotations about the centroid), shape (n, 3, 6)."""
    d = points_mm - points_mm.mean(axis=0)
    out = np.zeros((points_mm.shape[0], 3, 6))
    out[:, :, :3] = np.eye(3)
    for k in range(3):
        out[:, :, 3 + k] = np.cross(np.eye(3)[k], d)
    return out


def remove_rigid(points_mm: F2, deviation_mm: F2) -> F2:
    """Deviation left after the best-fit small rigid motion (least squares), shape (n, 3)."""
    a = rigid_design(points_mm).reshape(-1, 6)
    fit = a @ np.linalg.lstsq(a, deviation_mm.ravel(), rcond=None)[0]
    return np.asarray(deviation_mm - fit.reshape(-1, 3))


@dataclass(frozen=True, slots=True)
class FieldStatistics:
    """Rms and maximum of the deviation's length with the rigid motion removed, mm."""

    rms_mm: float
    max_mm: float


def field_statistics(points_mm: F2, deviation_mm: F2) -> FieldStatistics:
    """Rms and maximum length of the deviation vectors after removing the best-fit rigid motion."""
    length: F1 = np.linalg.norm(remove_rigid(points_mm, deviation_mm), axis=1)
    return FieldStatistics(float(np.sqrt(np.mean(length**2))), float(length.max()))
