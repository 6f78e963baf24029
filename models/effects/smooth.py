"""Smooth functions of one axis as columns of unit mean square over its stroke, for errors that a rigid-body model of six does not hold."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.effects.columns import UM, along, axis_of, of_path
from abbe.models.effects.effect import Form, Signal, Values
from abbe.models.effects.path import Path, Places
from abbe.models.functions.legendre import legendre_values

WITH_LINE = (2.5, 1.5)
"""Rms of a smooth curve over that of its bent part (its line, which scale and squareness swallow, taken away), and its standard
uncertainty. Of a stationary curve whose correlation length is 0.3 strokes: half of all curves have 2.6 or more, two of three 1.5 to 5."""
WITH_CONSTANT = (1.4, 0.7)
"""Of the same curves, rms over that without their constant: half have 1.4 or more, two of three 1.0 to 2.6."""


def smooth(position_mm: F1, stroke_mm: F1, first: int, last: int) -> F2:
    """Legendre polynomials of orders ``first`` to ``last`` over the stroke, each with mean square 1 there, shape (n, last - first + 1)."""
    orders = np.arange(first, last + 1)
    return np.asarray(legendre_values(position_mm, stroke_mm, last)[:, first:] * np.sqrt(2.0 * orders + 1.0))


def shifts(direction: Callable[[str], int], first: int, last: int) -> Signal:
    """A translation as a smooth function of the axis of a key, orders ``first`` to ``last``, 1 um rms over the stroke each.

    ``direction``: the component (0 to 2) that a key moves the tool in.
    """

    def moved(path: Path, at: Places, key: str, values: Values) -> F3:
        a = axis_of(key)
        return along(direction(key), *(UM * smooth(at.q_mm[:, a], path.machine.stroke_mm[a], first, last)).T)

    return of_path(moved)


def finer_shifts(direction: Callable[[str], int]) -> tuple[Form, ...]:
    """Freedoms of form of such a translation: orders 7 to 9, and 10 to 13."""
    return Form("finer", shifts(direction, 7, 9)), Form("finest", shifts(direction, 10, 13))
