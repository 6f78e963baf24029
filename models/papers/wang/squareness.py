"""Squareness from the four body diagonals' end values, eq (12) and (13), and what the printed solution is worth (math.md 5.3).

X, Y, Z are total travels, R the diagonal. Signs of (12), (13) are acute positive: the negative of (9) and (11). The bias-free solution is
`abbe.models.solvers.step_diagonal.squareness_contrast`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1
from abbe.models.paths.lines import DIAGONALS
from abbe.models.solvers.step_diagonal import ORDER


@dataclass(frozen=True, slots=True)
class AcuteSquareness:
    """Acute-positive squareness of eq (12) and (13), rad."""

    theta_yz: float
    theta_zx: float
    theta_xy: float


def diagonal_totals_eq12(acute: AcuteSquareness, length_mm: F1, scale: F1 | None = None) -> dict[str, float]:
    """Deviation at the end of each diagonal, eq (12), with the scale errors that the paper leaves out, mm.

    Parameters
    ----------
    length_mm : array, shape (3,)
        Total travels X, Y, Z.
    scale : array, shape (3,), optional
        Relative length errors of the axes (default: none, as printed).
    """
    x, y, z = _length(length_mm)
    r = float(np.sqrt(x * x + y * y + z * z))
    e = np.zeros(3) if scale is None else np.asarray(scale, dtype=np.float64)
    common = float((np.array([x, y, z]) ** 2) @ e)
    out = {}
    for name in ORDER:
        sx, sy, sz = DIAGONALS[name]
        out[name] = (common + sx * sy * x * y * acute.theta_xy + sy * sz * y * z * acute.theta_yz + sx * sz * x * z * acute.theta_zx) / r
    return out


def squareness_eq13_printed(totals_mm: dict[str, float], length_mm: F1) -> AcuteSquareness:
    """Eq (13) as printed, acute positive: every value carries the bias of `bias_eq13` (erratum W (13)).

    Parameters
    ----------
    totals_mm : dict of float
        Deviation at the end of ppp, npp, pnp, ppn.
    length_mm : array, shape (3,)
        Total travels X, Y, Z.
    """
    x, y, z = _length(length_mm)
    r = float(np.sqrt(x * x + y * y + z * z))
    p = totals_mm["ppp"]
    return AcuteSquareness(
        (p + totals_mm["npp"]) * r / (2 * y * z), (p + totals_mm["pnp"]) * r / (2 * z * x), (p + totals_mm["ppn"]) * r / (2 * x * y)
    )


def bias_eq13(scale: F1, length_mm: F1) -> AcuteSquareness:
    """What scale errors add to the three values of eq (13): sum(X_i² e_i) over YZ, ZX, XY (erratum W (13), math.md 5.3).

    Parameters
    ----------
    scale : array, shape (3,)
        Relative length errors of X, Y, Z, positive = the axis travels too far.
    length_mm : array, shape (3,)
        Total travels X, Y, Z.

    Returns
    -------
    AcuteSquareness
        To be subtracted from `squareness_eq13_printed`, rad, acute positive.

    Raises
    ------
    ValueError
        Travels are not three positive numbers.
    """
    x, y, z = _length(length_mm)
    common = float((np.array([x, y, z]) ** 2) @ np.asarray(scale, dtype=np.float64))
    return AcuteSquareness(common / (y * z), common / (z * x), common / (x * y))


def sum_test_mm(totals_mm: dict[str, float]) -> float:
    """ppp + npp + pnp + ppn, mm: 0 by eq (12), 4 sum(X_i² e_i) / R with scale errors. Unless it is 0, (13) must not be used."""
    return float(sum(totals_mm[name] for name in ORDER))


def common_scale(totals_mm: dict[str, float], length_mm: F1) -> float:
    """The only scale figure that plain diagonals tell: sum(X_i² e_i) / R², relative length error of the mean diagonal (math.md 5.3).

    Not in the paper, whose (12) leaves the scale errors out.

    Parameters
    ----------
    totals_mm : dict of float
        Deviation at the end of ppp, npp, pnp, ppn, mm.
    length_mm : array, shape (3,)
        Total travels X, Y, Z.

    Returns
    -------
    float, no unit (mm/mm), positive = the diagonals are too long.

    Raises
    ------
    ValueError
        Travels are not three positive numbers.
    """
    x, y, z = _length(length_mm)
    return 0.25 * sum_test_mm(totals_mm) / float(np.sqrt(x * x + y * y + z * z))


def _length(length_mm: F1) -> tuple[float, float, float]:
    a = np.asarray(length_mm, dtype=np.float64)
    if a.shape != (3,) or not (a > 0).all():
        raise ValueError(f"diagonals: travels must be three positive numbers, got {length_mm!r}")
    return float(a[0]), float(a[1]), float(a[2])
