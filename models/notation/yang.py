"""Names and signs of Yang and Kim in ISO 230-1 motions.

The workpiece lies on the Z cross slide. The paper writes delta_ij and eps_ij: i is the direction (or rotation axis), j the moving axis. The
errors of Z are the SLIDE's own motion, so the ISO errors of Z have the opposite sign, and the scale z runs against the workpiece
coordinate. The Z line is the datum of squareness: the X line runs along (1, 0, -Sxz), the Y line along (-Sxy, 1, -Syz), in
workpiece coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.machine import Machine

CHAIN = "w-Z-b-X-Y-t"
"""Workpiece - Z cross slide - bed - X saddle - Y spindle carrier - tool."""


@dataclass(frozen=True)
class YangErrors:
    """The 21 errors of the paper at n positions.

    Attributes
    ----------
    d : array, shape (n, 3, 3)
        delta_ij in mm: ``d[:, i, j]`` is the error in direction i of the motion along j; j = 2: motion of the Z slide itself.
    e : array, shape (n, 3, 3)
        eps_ij in rad: ``e[:, i, j]`` is the error about axis i of the motion along j; j = 2: rotation of the Z slide itself.
    sxy, sxz, syz : float
        Squareness in rad: angle between the positive axes minus 90 degrees.
    """

    d: F3
    e: F3
    sxy: float = 0.0
    sxz: float = 0.0
    syz: float = 0.0

    def __post_init__(self) -> None:
        """Check the shapes."""
        if self.d.shape != self.e.shape or self.d.ndim != 3 or self.d.shape[1:] != (3, 3):
            raise ValueError(f"Yang errors: d and e must both have shape (n, 3, 3), got {self.d.shape} and {self.e.shape}")


def machine(stroke_mm: F2, tool_mm: F1) -> Machine:
    """Return the nominal geometry of the paper's machine.

    Parameters
    ----------
    stroke_mm : array, shape (3, 2)
        WORKPIECE coordinates: a Z slide that travels 0..508 covers -508..0.
    tool_mm : array, shape (3,)
        The paper's T, with L added to its third component: (Tx, Ty, Tz + L).
    """
    return Machine(CHAIN, np.asarray(stroke_mm, dtype=np.float64), tool_mm=np.asarray(tool_mm, dtype=np.float64))


def workpiece_mm(slide_mm: F2) -> F2:
    """Convert scales (x, y, slide z) to commanded coordinates of the tool over the workpiece, (x, y, -z), or back.

    Erratum: (4), (8) and (9) of the paper use the z of the slide itself.

    Parameters
    ----------
    slide_mm : array, shape (..., 3)
        Scales x, y, z, mm; z is that of the cross slide, which carries the workpiece.

    Returns
    -------
    array, shape (..., 3), mm: workpiece coordinates without the constant tool vector T.
    """
    return np.asarray(np.asarray(slide_mm, dtype=np.float64) * np.array([1.0, 1.0, -1.0]))


def iso_motions(errors: YangErrors, slide_mm: F2) -> F3:
    """Convert the paper's 21 errors to ISO error motions.

    Parameters
    ----------
    errors : YangErrors
        Errors at the n positions.
    slide_mm : array, shape (n, 3)
        Scales x, y, z of the machine (z of the cross slide), mm.

    Returns
    -------
    array, shape (n, 3 axes X Y Z, 6)
        EX EY EZ (mm, squareness times travel included) and EA EB EC (rad), workpiece coordinates, ISO signs: X and Y as printed, Z with
        the opposite sign. Source: (1) of the paper, which has no erratum.

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
    """Return the paper's squareness under ISO names, rad: C0Y = +Sxy, B0Z = -Sxz, A0Z = +Syz.

    The paper's datum is the Z line, ours the X line, so maps agree only after a rigid rotation (`geometry.volume.remove_rigid`).
    """
    return {"C0Y": sxy, "B0Z": -sxz, "A0Z": syz}
