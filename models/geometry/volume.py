"""Deviation over a volume: grid, best-fit rigid motion, rms and maximum, and the deviation per unit of each coefficient.

The pose of the workpiece is not a property of the machine. So error maps can be compared only after the best-fit rigid motion over one
volume is removed from each map and from its uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.geometry.bases import Term
from abbe.models.geometry.chain import design
from abbe.models.machine import Machine, with_tool


def volume_grid(box_mm: F2, nodes: int) -> F2:
    """Return an equidistant grid over a box (shape (3, 2)), X slowest, shape (nodes**3, 3)."""
    axes = [np.linspace(lo, hi, nodes) for lo, hi in box_mm]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def rigid_design(points_mm: F2) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Return the displacement by 3 translations and 3 small rotations about the centroid, per unit of each, shape (n, 3, 6)."""
    d = points_mm - points_mm.mean(axis=0)
    out = np.zeros((points_mm.shape[0], 3, 6))
    out[:, :, :3] = np.eye(3)
    for k in range(3):
        out[:, :, 3 + k] = np.cross(np.eye(3)[k], d)
    return out


def remove_rigid(points_mm: F2, deviation_mm: F2) -> F2:
    """Return the deviation without its best-fit small rigid motion (least squares), shape (n, 3)."""
    a = rigid_design(points_mm).reshape(-1, 6)
    fit = a @ np.linalg.lstsq(a, deviation_mm.ravel(), rcond=None)[0]
    return np.asarray(deviation_mm - fit.reshape(-1, 3))


@dataclass(frozen=True, slots=True)
class FieldStatistics:
    """Rms and maximum of the length of the deviation vectors, rigid motion removed, mm."""

    rms_mm: float
    max_mm: float


def field_statistics(points_mm: F2, deviation_mm: F2) -> FieldStatistics:
    """Return the rms and maximum length of the deviation vectors after removal of the best-fit rigid motion."""
    length: F1 = np.linalg.norm(remove_rigid(points_mm, deviation_mm), axis=1)
    return FieldStatistics(float(np.sqrt(np.mean(length**2))), float(length.max()))


@dataclass(frozen=True)
class RigidFree:
    """A frame in which the deviation has no best-fit rigid motion over these reference points, shape (k, 3)."""

    reference_mm: F2

    def __post_init__(self) -> None:
        """Check that there are enough points for the six unknowns of a rigid motion."""
        if self.reference_mm.ndim != 2 or self.reference_mm.shape[1] != 3 or len(self.reference_mm) < 3:
            raise ValueError(f"rigid-free frame: expected 3 or more reference points in shape (k, 3), got shape {self.reference_mm.shape}")


def volume_frame(machine: Machine, nodes: int = 5) -> RigidFree:
    """Return the rigid-free frame of a machine's whole volume, with reference points on an equidistant grid over the strokes."""
    return RigidFree(volume_grid(machine.stroke_mm, nodes))


def unit_deviation(machine: Machine, terms: tuple[Term, ...], points_mm: F2, tool_mm: F1 | None, frame: RigidFree | None) -> F3:
    """Return the deviation per unit of each coefficient at points, shape (m, 3, len(terms)), in a rigid-free frame or the machine's own.

    ``tool_mm`` and ``frame``: None for the machine's own.
    """
    m = with_tool(machine, tool_mm)
    at = design(m, terms, points_mm)
    if frame is None:
        return at
    return np.asarray(at - rigid_at(points_mm, frame.reference_mm) @ rigid_fit(frame, design(m, terms, frame.reference_mm)))


def rigid_fit(frame: RigidFree, at_reference: F3) -> F2:
    """Return the best-fit rigid motion of p deviations at the reference points, shape (k, 3, p): mm and rad, shape (6, p)."""
    flat = rigid_design(frame.reference_mm).reshape(-1, 6)
    return np.asarray(np.linalg.lstsq(flat, at_reference.reshape(len(flat), -1), rcond=None)[0])


def rigid_at(points_mm: F2, reference_mm: F2) -> F3:
    """Return `rigid_design` at other points, with rotations about the centroid of the reference points, shape (m, 3, 6)."""
    centre = reference_mm.mean(axis=0)
    balanced = np.concatenate([points_mm, 2.0 * centre - points_mm])  # the centroid is ``centre``
    return rigid_design(balanced)[: len(points_mm)]
