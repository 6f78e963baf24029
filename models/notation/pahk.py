"""Pahk's ten machine types and parameters in ISO 230-1 names; P (n) is equation n of Pahk 1995."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.machine import Machine, split_chain


@dataclass(frozen=True)
class PahkType:
    """One of Pahk's ten machine types.

    Parameters
    ----------
    name : str
        MB, FB, MH, FH (moving/fixed bridge, moving/fixed horizontal arm) 1 or 2, CX, CY (column).
    chain : str
        Carriages from the workpiece over the bed to the tool; Pahk's "Y F X Z" is ``w-Y-b-X-Z-t``.
    alpha_sign : float
        +1 if alpha is obtuse-positive (theta_XY = +alpha), -1 if it is acute-positive. It is acute-positive if X is on the workpiece side:
        the printed lateral term -alpha X then acts on a table that moves by -X.
    """

    name: str
    chain: str
    alpha_sign: float

    @property
    def work_side(self) -> F1:
        """1 for axes between bed and workpiece, else 0, shape (3,)."""
        side = np.zeros(3)
        side[list(split_chain(self.chain)[0])] = 1.0
        return side


TYPES: dict[str, PahkType] = {
    t.name: t
    for t in (
        PahkType("MB1", "w-b-Y-X-Z-t", 1.0),
        PahkType("MB2", "w-b-X-Y-Z-t", 1.0),
        PahkType("FB1", "w-Y-b-X-Z-t", 1.0),
        PahkType("FB2", "w-X-b-Y-Z-t", -1.0),
        PahkType("MH1", "w-b-Y-Z-X-t", 1.0),
        PahkType("MH2", "w-b-X-Z-Y-t", 1.0),
        PahkType("FH1", "w-X-b-Y-Z-t", -1.0),
        PahkType("FH2", "w-Y-b-X-Z-t", 1.0),
        PahkType("CX", "w-Y-X-b-Z-t", -1.0),
        PahkType("CY", "w-X-Y-b-Z-t", -1.0),
    )
}
"""The ten types by name. FH1 and FB2 have the same chain, as have FH2 and FB1: ten names give eight distinct equations."""


def pahk_type(name: str) -> PahkType:
    """Return a type by its name; ValueError if there is no such type."""
    if name not in TYPES:
        raise ValueError(f"Pahk type {name!r}: expected one of {', '.join(TYPES)}")
    return TYPES[name]


def pahk_machine(kind: PahkType, stroke_mm: F2, probe_offset_mm: F1 | None = None) -> Machine:
    """Return the nominal machine of a type: pivots at zero, and the probe offset (Xp, Yp, Zp) as tool vector.

    Parameters
    ----------
    stroke_mm : array, shape (3, 2)
    probe_offset_mm : array, shape (3,), optional
        Default: zero.

    Raises
    ------
    ValueError
        A shape is wrong or a stroke is empty.
    """
    return Machine(kind.chain, stroke_mm, tool_mm=np.zeros(3) if probe_offset_mm is None else probe_offset_mm)


def parameter_signs(kind: PahkType) -> F2:
    """Return the signs that turn Pahk's functions of an axis into ISO motions and back, shape (3 axes, 6: dx dy dz Ex Ey Ez).

    The signs are +1 on the tool side. On the workpiece side Pahk states the table's own motion: lateral d and all E change sign, the d
    along the axis does not.
    """
    signs = np.ones((3, 6))
    for j in np.flatnonzero(kind.work_side):
        signs[j] = -1.0
        signs[j, j] = 1.0
    return signs


def squareness_slopes(kind: PahkType) -> F3:
    """Return ISO translations per mm of travel and rad of alpha, beta1, beta2, shape (3 axes, 3 directions, 3 parameters).

    Y is the datum; the X line runs along (1, -alpha, 0), the Z line along (-beta1, -beta2, 1): P (2), (3) with the erratum that Lz holds
    -beta1 Z. If X is on the workpiece side, its lateral entry belongs to the table and changes sign.
    """
    slopes = np.zeros((3, 3, 3))
    slopes[0, 1, 0] = -kind.alpha_sign
    slopes[2, 0, 1] = -1.0
    slopes[2, 1, 2] = -1.0
    return slopes


def motions_from_pahk(kind: PahkType, axes_mm: F2, d_mm: F3, e_rad: F3, squareness_rad: F1) -> F3:
    """Convert Pahk's functions and squareness at commanded positions to ISO motions for `abbe.models.geometry.chain`.

    Parameters
    ----------
    axes_mm : array, shape (n, 3)
    d_mm : array, shape (n, 3 axes j, 3 directions i)
        d_i(j) at these positions, mm, Pahk's signs.
    e_rad : array, shape (n, 3 axes j, 3 directions i)
        E_i(j) at these positions, rad, Pahk's signs.
    squareness_rad : array, shape (3,)
        alpha, beta1, beta2; beta1 = XZ, beta2 = YZ as in the equations (Pahk's nomenclature list exchanges them).

    Returns
    -------
    array, shape (n, 3 axes, 6)
        EX EY EZ (mm, squareness as slope times travel included) and EA EB EC (rad), ISO signs.

    Raises
    ------
    ValueError
        A shape is wrong.
    """
    axes, d, e = (np.asarray(v, dtype=np.float64) for v in (axes_mm, d_mm, e_rad))
    angles = np.asarray(squareness_rad, dtype=np.float64)
    shape = (axes.shape[0], 3, 3)
    if axes.ndim != 2 or axes.shape[1] != 3 or d.shape != shape or e.shape != shape or angles.shape != (3,):
        raise ValueError(
            f"Pahk motions: expected axes (n, 3), d and E (n, 3, 3), 3 angles; got {axes.shape}, {d.shape}, {e.shape}, {angles.shape}"
        )
    motions: F3 = np.concatenate([d, e], axis=2) * parameter_signs(kind)
    motions[:, :, :3] += axes[:, :, None] * (squareness_slopes(kind) @ angles)
    return motions


def pahk_from_motions(kind: PahkType, axes_mm: F2, motions: F3, squareness_rad: F1) -> tuple[F3, F3]:
    """Invert `motions_from_pahk` for known squareness: return (d_mm, e_rad), each (n, 3 axes j, 3 directions i), with Pahk's signs."""
    own: F3 = np.array(motions, dtype=np.float64)
    own[:, :, :3] -= np.asarray(axes_mm)[:, :, None] * (squareness_slopes(kind) @ np.asarray(squareness_rad))
    own *= parameter_signs(kind)
    return own[:, :, :3], own[:, :, 3:]


def iso_squareness(kind: PahkType, squareness_rad: F1) -> F1:
    """Convert alpha, beta1, beta2 to C0Y, B0Z, A0Z (rad, right-handed, shape (3,)).

    theta_XY = alpha_sign * alpha = C0Y, theta_XZ = beta1 = -B0Z, theta_YZ = beta2 = A0Z. Pahk's datum is the Y line, ours the X line, so
    deviation maps agree only after a best-fit rotation.
    """
    signs: F1 = np.array([kind.alpha_sign, -1.0, 1.0])
    return signs * np.asarray(squareness_rad, dtype=np.float64)


def pahk_squareness(kind: PahkType, iso_rad: F1) -> F1:
    """Convert C0Y, B0Z, A0Z to alpha, beta1, beta2 (rad, shape (3,)), alpha with the sign of the type; inverse of `iso_squareness`."""
    return iso_squareness(kind, iso_rad)
