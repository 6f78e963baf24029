"""Squareness from the four body diagonals' end values, eq (12) and (13), and what angular errors do to eq (7) (math.md 5.2, 5.3).

X, Y, Z are total travels, R the diagonal. Signs of (12), (13) are acute positive: the negative of (9) and (11). The bias-free solution is
`abbe.models.solvers.step_diagonal.squareness_contrast`.

Angular errors of the machine FXYZ, step order X, Y, Z, make Abbe terms and spurious straightness, positioning and squareness. The closure
test shows nothing of this beyond one step's size: a machine with pure yaw looks bent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F3
from abbe.models.paths import DIAGONALS
from abbe.models.solvers.step_diagonal import ORDER, checked_increments


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
    """The only scale figure that plain diagonals determine: sum(X_i² e_i) / R², relative length error of the mean diagonal (math.md 5.3).

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


def abbe_and_spurious_eq7(n: int, inc_mm: F1, x_step_rad: F1, y_step_rad: F1) -> F3:
    """Displacement per interval that eq (7) returns for constant angular rates alone, shape (3 directions i, 3 axes a, n), mm.

    Parameters
    ----------
    n : int
        Intervals per axis.
    inc_mm : array, shape (3,)
        Increments X, Y, Z.
    x_step_rad, y_step_rad : array, shape (3,)
        Rotation about X, Y, Z that the X (Y) carriage gains in each of its intervals. Z's rotations and Y's yaw turn nothing that a mirror
        at tool 0 would show.

    Returns
    -------
    array
        First order. Abbe terms at mid volume are what a diagonal may be expected to see; terms with (n + 2 - 2j), (n + 1 - 2j),
        (2j - n - 1) or j are spurious: errors that the machine has nowhere. The effect of Y's rotations on the Z steps is not tabulated in
        math.md; it is the same calculation with the lever (0, 0, Z).

    Raises
    ------
    ValueError
        n < 1, an array is not of shape (3,), or an increment not positive.
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
    """Height of the parabola of false straightness EYX that a constant yaw rate makes, about L theta / 8, mm (math.md 5.2)."""
    return length_mm * total_yaw_rad / 8.0


def closure_of_angles_mm(inc_mm: F1, x_step_rad: F1) -> float:
    """Closure of one X interval from X's rotations, X (Y az - Z ay) / R: one step's size, so the test does not find angular errors.

    Source: math.md 5.2 (not in the paper).

    Parameters
    ----------
    inc_mm : array, shape (3,)
        Increments X, Y, Z, positive.
    x_step_rad : array, shape (3,)
        Rotation about X, Y, Z that the X carriage gains in one interval, right-handed.

    Returns
    -------
    float, mm: ppp - npp - pnp - ppn as `abbe.models.solvers.step_diagonal.closure_mm`, with its sign.

    Raises
    ------
    ValueError
        Increments not positive, or rotations not of shape (3,).
    """
    if np.shape(x_step_rad) != (3,):
        raise ValueError(f"angular errors: x_step_rad must have shape (3,), got {np.shape(x_step_rad)}")
    x, y, z = checked_increments(inc_mm)
    return float(x * (y * x_step_rad[2] - z * x_step_rad[1]) / np.linalg.norm(inc_mm))
