"""What a ball-bar reads, eq (4)-(8): exactly, to first order, and how far the two can differ (math.md 4.2)."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2


def reading_eq6(d_mm: F2, error_mm: F2) -> F1:
    """Change of the bar's length, eq (6) without linearisation: |d + error| - |d|.

    Parameters
    ----------
    d_mm : array, shape (n, 3)
        Nominal position minus nominal centre, w - w0, WORKPIECE coordinates.
    error_mm : array, shape (n, 3)
        Delta - Delta0: error at the position minus the error (or the mounting offset) of the centre.

    Returns
    -------
    array, shape (n,), mm, positive = longer. Computed without subtracting the two lengths, so that no digits are lost. Erratum: in the
    printed (6) and (7) the fraction bar runs into the root (math.md 3).

    Raises
    ------
    ValueError
        Shapes differ, or a point lies at the centre: no bar has length 0.
    """
    _bar_mm(d_mm, error_mm)
    change = np.einsum("ni,ni->n", error_mm, 2.0 * d_mm + error_mm)
    return np.asarray(change / (np.linalg.norm(d_mm + error_mm, axis=1) + np.linalg.norm(d_mm, axis=1)))


def reading_eq8(d_mm: F2, error_mm: F2) -> F1:
    """The same to first order, eq (8): (w - w0) . (Delta - Delta0) / R, shape (n,), mm.

    Parameters, errors: as `reading_eq6`; R is the length of each row of ``d_mm``. Erratum: the paper takes the slide's z for a workpiece
    coordinate; WORKPIECE coordinates are wanted here (math.md 3 row Y (8), 4.2). What it leaves out: `second_order_bound_mm`.
    """
    return np.asarray(np.einsum("ni,ni->n", d_mm, error_mm) / _bar_mm(d_mm, error_mm))


def second_order_bound_mm(error_mm: F2, radius_mm: float) -> F1:
    """Largest possible difference of the two, |Delta - Delta0|² / (2 R), to second order, shape (n,), mm (math.md 4.2).

    Raises
    ------
    ValueError
        Radius not positive.
    """
    _positive(radius_mm)
    return np.asarray((error_mm**2).sum(axis=1) / (2.0 * radius_mm))


def measured_mm(tip_mm: F2, ball_mm: F1, radius_mm: float, bar_offset_mm: float = 0.0) -> F1:
    """Bar reading from where the two balls really are: |tip - ball| - R + offset, shape (n,).

    Parameters
    ----------
    tip_mm, ball_mm : array, shape (n, 3) and (3,)
        Actual tool tips and the fixed ball, workpiece coordinates (set-up error of the ball included).
    radius_mm, bar_offset_mm : float
        Nominal length; how much longer the bar reads than it is.

    Raises
    ------
    ValueError
        Radius not positive.
    """
    _positive(radius_mm)
    return np.asarray(np.linalg.norm(tip_mm - ball_mm, axis=1) - radius_mm + bar_offset_mm)


def _bar_mm(d_mm: F2, error_mm: F2) -> F1:
    """Nominal lengths, shape (n,), none of them 0."""
    if np.ndim(d_mm) != 2 or np.shape(d_mm)[1] != 3 or np.shape(error_mm) != np.shape(d_mm):
        raise ValueError(f"ball-bar: positions {np.shape(d_mm)} and errors {np.shape(error_mm)} must both have shape (n, 3)")
    length: F1 = np.linalg.norm(d_mm, axis=1)
    if not (length > 0).all():
        raise ValueError(f"ball-bar: point {int(np.argmin(length > 0))} lies at the centre (or nowhere), a bar has a length")
    return length


def _positive(radius_mm: float) -> None:
    if not 0 < radius_mm < np.inf:
        raise ValueError(f"ball-bar: radius {radius_mm} mm must be positive")
