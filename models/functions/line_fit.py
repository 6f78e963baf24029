"""Least-squares straight lines through measured errors: Pahk's slope m[.], Yang and Kim's Tables 2 and 3."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1


def straight_line(x: F1, y: F1) -> tuple[float, float]:
    """Fit an ordinary least-squares line.

    Parameters
    ----------
    x, y : arrays, shape (n,)
        Positions and values, any units.

    Returns
    -------
    tuple of float
        Slope (unit of y per unit of x) and value at x = 0.

    Raises
    ------
    ValueError
        Shapes differ, or fewer than two different positions.
    """
    a, b = _pair(x, y)
    centred = a - a.mean()
    power = float(centred @ centred)
    if power == 0.0:
        raise ValueError("straight line: at least two different positions are needed")
    slope = float(centred @ b) / power
    return slope, float(b.mean() - slope * a.mean())


def slope_through_origin(x: F1, y: F1) -> float:
    """Return the least-squares slope of a line through (0, 0), as in the laser columns of Yang and Kim's Table 2.

    Shapes, units and errors are those of `straight_line`, but one position other than zero is enough.
    """
    a, b = _pair(x, y)
    power = float(a @ a)
    if power == 0.0:
        raise ValueError("slope through the origin: at least one position other than zero is needed")
    return float(a @ b) / power


def _pair(x: F1, y: F1) -> tuple[F1, F1]:
    a, b = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if a.ndim != 1 or a.shape != b.shape or a.size == 0:
        raise ValueError(f"straight line: positions and values must be vectors of one length, got shapes {a.shape} and {b.shape}")
    return a, b
