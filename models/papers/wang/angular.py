"""What angular errors do to eq (7): Abbe terms, and spurious straightness, positioning and squareness (math.md 5.2).

Machine FXYZ, step order X, Y, Z. The closure test does not see any of this beyond one step's size: a machine with pure yaw looks bent.
"""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F3
from abbe.models.solvers.step_diagonal import checked_increments


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
