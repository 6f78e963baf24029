"""Squareness from the end values of the four body diagonals, (12) and (13), and the effect of angular errors on (7).

X, Y, Z are total travels, R is the diagonal. The squareness of (12), (13) is acute positive, that of (9) and (11) obtuse positive. The
bias-free solution is `abbe.models.solvers.step_diagonal.squareness_contrast`.

Angular errors of the machine FXYZ, with step order X, Y, Z, cause Abbe terms and spurious straightness, positioning and squareness; a
machine with pure yaw seems bent. Of these errors, the closure test shows only the contribution of one step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F3
from abbe.models.paths import DIAGONALS
from abbe.models.solvers.step_diagonal import ORDER, checked_increments


@dataclass(frozen=True, slots=True)
class AcuteSquareness:
    """Acute-positive squareness of (12) and (13), rad."""

    theta_yz: float
    theta_zx: float
    theta_xy: float


def diagonal_totals_eq12(acute: AcuteSquareness, length_mm: F1, scale: F1 | None = None) -> dict[str, float]:
    """Return the deviation at the end of each diagonal, (12), with the scale errors that the paper neglects, mm.

    Parameters
    ----------
    length_mm : array, shape (3,)
        Total travels X, Y, Z.
    scale : array, shape (3,), optional
        Relative length errors of the axes. Default: zero, as in the paper.
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
    """Evaluate (13) as printed, acute positive. Erratum: every value has the bias `bias_eq13`.

    Parameters
    ----------
    totals_mm : dict of float
        Deviation at the end of ppp, npp, pnp, ppn, mm.
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
    """Return the bias of the three values of (13) by scale errors: sum(X_i² e_i) divided by YZ, ZX, XY.

    Parameters
    ----------
    scale : array, shape (3,)
        Relative length errors of X, Y, Z, positive = the axis travels too far.
    length_mm : array, shape (3,)
        Total travels X, Y, Z.

    Returns
    -------
    AcuteSquareness
        Bias to be subtracted from `squareness_eq13_printed`; rad, acute positive.

    Raises
    ------
    ValueError
        Travels are not three positive numbers.
    """
    x, y, z = _length(length_mm)
    common = float((np.array([x, y, z]) ** 2) @ np.asarray(scale, dtype=np.float64))
    return AcuteSquareness(common / (y * z), common / (z * x), common / (x * y))


def sum_test_mm(totals_mm: dict[str, float]) -> float:
    """Return ppp + npp + pnp + ppn, mm: 0 by (12), 4 sum(X_i² e_i) / R with scale errors. Use (13) only if this sum is 0."""
    return float(sum(totals_mm[name] for name in ORDER))


def common_scale(totals_mm: dict[str, float], length_mm: F1) -> float:
    """Return the only scale error that plain diagonals determine: sum(X_i² e_i) / R², the relative length error of the mean diagonal.

    The paper does not have this result, because its (12) neglects scale errors.

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


def abbe_and_spurious_eq7(n: int, inc_mm: F1, x_step_rad: F1, y_step_rad: F1) -> F3:
    """Return the displacement per interval that (7) yields for constant angular rates alone, shape (3 directions i, 3 axes a, n), mm.

    Parameters
    ----------
    n : int
        Intervals per axis.
    inc_mm : array, shape (3,)
        Increments X, Y, Z.
    x_step_rad, y_step_rad : array, shape (3,)
        Change of the rotation about X, Y, Z of the X (Y) carriage in each of its intervals. Rotations of Z and the yaw of Y have no effect
        on a mirror at tool 0.

    Returns
    -------
    array
        First order. The Abbe terms at mid volume are real; terms with (n + 2 - 2j), (n + 1 - 2j), (2j - n - 1) or j, j being the number of
        the interval, are spurious: the machine does not have these errors anywhere.

    Raises
    ------
    ValueError
        n < 1, an array has another shape than (3,), or an increment is not positive.
    """
    for name, v in (("inc_mm", inc_mm), ("x_step_rad", x_step_rad), ("y_step_rad", y_step_rad)):
        if np.shape(v) != (3,):
            raise ValueError(f"angular errors: {name} must have shape (3,), got {np.shape(v)}")
    if n < 1:
        raise ValueError(f"angular errors: {n} intervals, expected 1 or more")
    inc = checked_increments(inc_mm)
    return _of_x(n, inc, x_step_rad) + _of_y(n, inc, y_step_rad)


def _of_x(n: int, inc_mm: F1, step: F1) -> F3:
    x, y, z = inc_mm
    ax, ay, az = step
    j, one = np.arange(1.0, n + 1.0), np.ones(n)
    out = np.zeros((3, 3, n))
    out[0, 0] = -(n - 1) / 2 * (y * az - z * ay) * one
    out[1, 0] = -n / 2 * z * ax + (n + 2 - 2 * j) / 2 * x * az
    out[2, 0] = n / 2 * y * ax - (n + 2 - 2 * j) / 2 * x * ay
    out[0, 1] = -n / 2 * y * az + (2 * j - n) / 2 * (y * z / x) * ax
    out[1, 1] = (n + 1 - 2 * j) / 2 * (x * az - z * ax)
    out[2, 1] = j * y * ax
    out[0, 2] = n / 2 * z * ay + (n - 2 * j) / 2 * (y * z / x) * ax
    out[1, 2] = -j * z * ax
    out[2, 2] = (2 * j - n - 1) / 2 * (x * ay - y * ax)
    return out


def _of_y(n: int, inc_mm: F1, step: F1) -> F3:
    x, y, z = inc_mm
    bx, by, _ = step
    j, one = np.arange(1.0, n + 1.0), np.ones(n)
    out = np.zeros((3, 3, n))
    out[0, 1] = (j - 1) * z * by
    out[1, 1] = (-(n - 1) / 2 * y * bx + (2 * j - n - 1) / 2 * x * by) * z / y
    out[2, 1] = (2 * j - n - 2) / 2 * (x * by - y * bx)
    out[0, 2] = j * z * by
    out[1, 2] = (2 * j - n) / 2 * (x * z / y) * by - n / 2 * z * bx * one
    out[2, 2] = (2 * j - n - 1) / 2 * (x * by - y * bx)
    return out


def false_straightness_mm(length_mm: float, total_yaw_rad: float) -> float:
    """Return the height of the false straightness EYX (a parabola) by a constant yaw rate, about L theta / 8, mm."""
    return length_mm * total_yaw_rad / 8.0


def closure_of_angles_mm(inc_mm: F1, x_step_rad: F1) -> float:
    """Return the closure of one X interval by rotations of X, X (Y az - Z ay) / R; not in the paper.

    This closure has the size of one step only, so the closure test does not find angular errors.

    Parameters
    ----------
    inc_mm : array, shape (3,)
        Increments X, Y, Z, positive.
    x_step_rad : array, shape (3,)
        Change of the rotation about X, Y, Z of the X carriage in one interval, right-handed.

    Returns
    -------
    float, mm: ppp - npp - pnp - ppn, as in `abbe.models.solvers.step_diagonal.closure_mm`.

    Raises
    ------
    ValueError
        An increment is not positive, or the rotations have another shape.
    """
    if np.shape(x_step_rad) != (3,):
        raise ValueError(f"angular errors: x_step_rad must have shape (3,), got {np.shape(x_step_rad)}")
    x, y, z = checked_increments(inc_mm)
    return float(x * (y * x_step_rad[2] - z * x_step_rad[1]) / np.linalg.norm(inc_mm))
