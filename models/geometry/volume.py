"""The deviation over a volume: grid, best-fit rigid motion, rms and maximum, and the deviation per unit of each coefficient.

The pose of the workpiece is not a property of the machine: two error maps are compared only after the best-fit rigid motion over one volume
is removed from both (math.md 3). It must be removed from their uncertainty too, which otherwise includes the frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.geometry.bases import Term
from abbe.models.geometry.chain import design
from abbe.models.machine import Machine, with_tool


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


@dataclass(frozen=True)
class RigidFree:
    """Frame of the deviation without its best-fit rigid motion over these points, shape (k, 3)."""

    reference_mm: F2

    def __post_init__(self) -> None:
        """Six unknowns of a rigid motion need points that do not lie on one line."""
        if self.reference_mm.ndim != 2 or self.reference_mm.shape[1] != 3 or len(self.reference_mm) < 3:
            raise ValueError(f"rigid-free frame: reference points of shape {self.reference_mm.shape}, expected (k, 3) with k of 3 or more")


def volume_frame(machine: Machine, nodes: int = 5) -> RigidFree:
    """The rigid-free frame of a machine's whole volume: reference points on an even grid over the strokes."""
    return RigidFree(volume_grid(machine.stroke_mm, nodes))


def unit_deviation(machine: Machine, terms: tuple[Term, ...], points_mm: F2, tool_mm: F1 | None, frame: RigidFree | None) -> F3:
    """Deviation per unit of each coefficient at points, shape (m, 3, len(terms)), in the machine's frame (None) or the rigid-free one."""
    m = with_tool(machine, tool_mm)
    at = design(m, terms, points_mm)
    if frame is None:
        return at
    reference = frame.reference_mm
    motion = rigid_design(reference)
    flat = motion.reshape(-1, 6)
    fitted = np.linalg.lstsq(flat, design(m, terms, reference).reshape(-1, len(terms)), rcond=None)[0]
    return np.asarray(at - rigid_at(points_mm, reference) @ fitted)


def rigid_at(points_mm: F2, reference_mm: F2) -> F3:
    """`rigid_design` of the reference points, at other points, shape (m, 3, 6)."""
    centre = reference_mm.mean(axis=0)
    balanced = np.concatenate([points_mm, 2.0 * centre - points_mm])  # their centroid is the reference's
    return rigid_design(balanced)[: len(points_mm)]
