"""Names and signs of Wang (paper 004; math.md 1 and 5) in ISO 230-1 motions.

The paper writes delta_i(J) and alpha_i(J): i the direction (or rotation axis), J the moving axis; signs are ISO's. X is the datum of
squareness, but the sign turns within the paper: equations (9) and (11) are obtuse positive (Y line (-theta_xy, 1, 0), Z line
(-theta_xz, -theta_yz, 1)), equations (12) and (13) acute positive.
"""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F2, F3
from abbe.models.machine import Machine

CHAIN = "w-b-X-Y-Z-t"
"""FXYZ: foundation with the workpiece, then X, Y, Z towards the tool."""

ACUTE_FROM_OBTUSE = -1.0
"""Squareness of (12) and (13) = this times that of (9) and (11)."""


def machine(stroke_mm: F2) -> Machine:
    """FXYZ with the functional point (the laser's mirror) at the spindle reference, tool (0, 0, 0); ``stroke_mm``: shape (3, 2)."""
    return Machine(CHAIN, np.asarray(stroke_mm, dtype=np.float64))


def iso_motions(d: F3, alpha: F3, theta: tuple[float, float, float], axes_mm: F2) -> F3:
    """Error motions of rule G from the paper's 21 errors.

    Parameters
    ----------
    d : array, shape (n, 3, 3)
        delta_i(J) in mm: ``d[:, i, j]`` in direction i of the motion along j, at the n positions.
    alpha : array, shape (n, 3, 3)
        alpha_i(J) in rad, likewise.
    theta : (theta_xy, theta_xz, theta_yz)
        Squareness in rad, obtuse positive as in (9) and (11); for values of (12) or (13) multiply by ACUTE_FROM_OBTUSE.
    axes_mm : array, shape (n, 3)
        Commanded positions.

    Returns
    -------
    array, shape (n, 3 axes X Y Z, 6)
        EX EY EZ (mm, squareness times travel included) and EA EB EC (rad), machine coordinates, ISO signs: as printed. Rule G on them gives
        eq (9) without its erratum (Pz: +y alpha_x(X); math.md 1, 3).

    Raises
    ------
    ValueError
        Errors and positions differ in number.
    """
    p = np.asarray(axes_mm, dtype=np.float64)
    if d.shape != (p.shape[0], 3, 3) or alpha.shape != d.shape:
        raise ValueError(f"Wang errors: d {d.shape} and alpha {alpha.shape} must both have shape ({p.shape[0]}, 3, 3)")
    out = np.concatenate([d, alpha], axis=1).transpose(0, 2, 1).copy()
    out[:, 1, 0] -= theta[0] * p[:, 1]
    out[:, 2, 0] -= theta[1] * p[:, 2]
    out[:, 2, 1] -= theta[2] * p[:, 2]
    return out


def iso_squareness(theta_xy: float, theta_xz: float, theta_yz: float) -> dict[str, float]:
    """Obtuse-positive squareness of (9) and (11) under ISO names, rad: C0Y = +theta_xy, B0Z = -theta_xz, A0Z = +theta_yz (math.md 1)."""
    return {"C0Y": theta_xy, "B0Z": -theta_xz, "A0Z": theta_yz}
