"""Readings that are off because of where the machine is, not because a beam was lost: those nearby are off as well."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2

NEAR_MM, LOUD = 30.0, 3.0
"""A reading so near tells of the same place; one counts up to so many standard deviations."""


def bound_to_places(q_mm: F2, rest: F1, off: NDArray[np.bool_]) -> tuple[float, F1]:
    """How far the readings near those that are off go along with them, standard deviations, and the middle of the place, (3,) mm.

    A lost beam is off once: readings nearby, and at the same place at another time, know nothing of it, so that the first is within 3.

    Parameters
    ----------
    q_mm : array, shape (n, 3)
        Tool positions.
    rest : array, shape (n,)
        Whitened residuals; exact zeros are no readings.
    off : array of bool, shape (n,)
        Which of them are off.
    """
    total = count = most = 0.0
    held, middle = np.clip(rest, -LOUD, LOUD), np.zeros(3)
    for i in np.flatnonzero(off):
        near = (np.linalg.norm(q_mm - q_mm[i], axis=1) < NEAR_MM) & (rest != 0.0)
        along = np.sign(rest[i]) * held * near
        total += float(along.sum() - along[i])
        count += float(near.sum()) - 1.0
        if float(along.sum()) > most:
            most = float(along.sum())
            middle = np.maximum(along, 0.0) @ q_mm / np.maximum(along, 0.0).sum()
    return (total / np.sqrt(count) if count else 0.0), np.asarray(middle)
