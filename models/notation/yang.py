"""Names and signs of Yang and Kim (paper 002; math.md 1 and 4.1) in ISO 230-1 motions.

Chain: workpiece on the Z cross slide, bed, X saddle, Y spindle carrier, tool. The paper writes delta_ij and eps_ij: i the direction (or
rotation axis), j the moving axis. The Z slide's errors are the SLIDE's own, so ISO Z = -(slide z), and the machine's scale z runs against
the workpiece coordinate. The Z line is the datum of squareness: the X line runs (1, 0, -Sxz), the Y line (-Sxy, 1, -Syz), in workpiece
coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.machine import Machine

CHAIN = "w-Z-b-X-Y-t"
"""Carriages from workpiece to tool: workpiece - Z cross slide - foundation - X saddle - Y spindle carrier - tool."""


@dataclass(frozen=True)
class YangErrors:
    """The 21 errors of the paper at n positions.

    Attributes
    ----------
    d : array, shape (n, 3, 3)
        delta_ij in mm: ``d[:, i, j]`` in direction i of the motion along j; j = 2 is the Z slide's own error.
    e : array, shape (n, 3, 3)
        eps_ij in rad: ``e[:, i, j]`` about axis i of the motion along j; j = 2 the Z slide's own rotation.
    sxy, sxz, syz : float
        Squareness in rad, obtuse positive (angle of the positive axes minus 90 degrees).
    """

    d: F3
    e: F3
    sxy: float = 0.0
    sxz: float = 0.0
    syz: float = 0.0

    def __post_init__(self) -> None:
        """Refuse arrays that are no (n, 3, 3)."""
        if self.d.shape != self.e.shape or self.d.ndim != 3 or self.d.shape[1:] != (3, 3):
            raise ValueError(f"Yang errors: d and e must both have shape (n, 3, 3), got {self.d.shape} and {self.e.shape}")


def machine(stroke_mm: F2, tool_mm: F1) -> Machine:
    """The paper's machine as nominal geometry.

    Parameters
    ----------
    stroke_mm : array, shape (3, 2)
        WORKPIECE coordinates: a Z slide that travels 0..508 covers -508..0.
    tool_mm : array, shape (3,)
        T with L merged into its third component: (Tx, Ty, Tz + L).
    """
    return Machine(CHAIN, np.asarray(stroke_mm, dtype=np.float64), tool_mm=np.asarray(tool_mm, dtype=np.float64))


def workpiece_mm(slide_mm: F2) -> F2:
    """Commanded coordinates of the tool over the workpiece from the machine's scales (x, y, slide z): (x, y, -z), math.md 4.1.

    Its own inverse: also turns workpiece coordinates into scales. Erratum: eq (4), (8) and (9) use the slide's z itself (math.md 3, 4.2).

    Parameters
    ----------
    slide_mm : array, shape (..., 3)
        Scales x, y, z, mm; z of the cross slide that carries the workpiece.

    Returns
    -------
    array, shape (..., 3), mm, workpiece coordinates without the constant tool vector T.
    """
    return np.asarray(np.asarray(slide_mm, dtype=np.float64) * np.array([1.0, 1.0, -1.0]))


def iso_motions(errors: YangErrors, slide_mm: F2) -> F3:
    """Error motions of rule G from the paper's 21 errors.

    Parameters
    ----------
    errors : YangErrors
        At the n positions.
    slide_mm : array, shape (n, 3)
        Scales x, y, z of the machine (z of the cross slide).

    Returns
    -------
    array, shape (n, 3 axes X Y Z, 6)
        EX EY EZ (mm, squareness times travel included) and EA EB EC (rad), workpiece coordinates, ISO signs: X and Y as printed,
        Z = -(slide). Source: eq (1), which has no erratum (math.md 1, 3, 4.1).

    Raises
    ------
    ValueError
        Errors and positions differ in number.
    """
    p = np.asarray(slide_mm, dtype=np.float64)
    if p.shape != (errors.d.shape[0], 3):
        raise ValueError(f"Yang errors of {errors.d.shape[0]} positions do not fit positions of shape {p.shape}")
    sign = np.array([1.0, 1.0, -1.0])
    out = np.empty((p.shape[0], 3, 6))
    out[:, :, :3] = (errors.d * sign).transpose(0, 2, 1)
    out[:, :, 3:] = (errors.e * sign).transpose(0, 2, 1)
    out[:, 0, 2] -= errors.sxz * p[:, 0]
    out[:, 1, 0] -= errors.sxy * p[:, 1]
    out[:, 1, 2] -= errors.syz * p[:, 1]
    return out


def iso_squareness(sxy: float, sxz: float, syz: float) -> dict[str, float]:
    """Squareness of the paper under ISO names, rad: C0Y = +Sxy, B0Z = -Sxz, A0Z = +Syz (math.md 1).

    The paper's datum is the Z line, ours the X line: maps agree after a rigid rotation only (`abbe.models.geometry.volume.remove_rigid`).
    """
    return {"C0Y": sxy, "B0Z": -sxz, "A0Z": syz}
