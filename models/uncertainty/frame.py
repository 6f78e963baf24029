"""Deviation per unit of each coefficient, as the machine's own frame sees it or with the best-fit rigid motion taken out.

Where the workpiece lies and how it is turned is no property of the machine: two error maps are compared only after the best-fit rigid
motion over one volume is removed from both (math.md 3). It must be removed from their uncertainty too, which otherwise includes the frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.geometry.bases import Term
from abbe.models.geometry.chain import design
from abbe.models.machine import Machine
from abbe.models.solvers.observe import with_tool
from abbe.models.volumetric import rigid_design, volume_grid


@dataclass(frozen=True)
class RigidFree:
    """The frame that is left when the best-fit rigid motion over these points, shape (k, 3), is taken out of the deviation."""

    reference_mm: F2

    def __post_init__(self) -> None:
        """Six unknowns of a rigid motion need points that do not lie on one line."""
        if self.reference_mm.ndim != 2 or self.reference_mm.shape[1] != 3 or len(self.reference_mm) < 3:
            raise ValueError(f"rigid-free frame: reference points of shape {self.reference_mm.shape}, expected (k, 3) with k of 3 or more")


def volume_frame(machine: Machine, nodes: int = 5) -> RigidFree:
    """The rigid-free frame of a machine's whole volume: reference points on an even grid over the strokes."""
    return RigidFree(volume_grid(machine.stroke_mm, nodes))


def field(machine: Machine, terms: tuple[Term, ...], points_mm: F2, tool_mm: F1 | None, frame: RigidFree | None) -> F3:
    """Deviation per unit of each coefficient at points, shape (m, 3, len(terms)), in the frame asked for."""
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
    """`abbe.models.volumetric.rigid_design` of the reference points, evaluated at other points, shape (m, 3, 6)."""
    centre = reference_mm.mean(axis=0)
    balanced = np.concatenate([points_mm, 2.0 * centre - points_mm])  # their centroid is the reference's
    return rigid_design(balanced)[: len(points_mm)]
