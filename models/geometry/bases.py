"""Smooth error functions of one axis: Legendre polynomials over the stroke that meet the datum rules.

Positioning and angles are zero at the start of the stroke. Straightness has no constant and no slope: it starts at order 2, and these
Legendre polynomials are orthogonal to 1 and x over the stroke.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre

from abbe.models.arrays import F1, F2, F3
from abbe.models.functions.legendre import legendre_values
from abbe.models.functions.motions import ROTATIONS, motion_names
from abbe.models.machine import AXES as DIRECTIONS

__all__ = ["DIRECTIONS", "ROTATIONS", "Term", "layout_of", "legendre_values", "motion_names", "smooth_terms", "term_motions", "term_values"]


class Term(NamedTuple):
    """One term of the model: the part of an error motion with one Legendre order; its coefficient is an unknown of a solution.

    ``motion``: e.g. ``"EYX"``, with ``order`` 1 or more; squareness is ``"C0Y"``, ``"B0Z"``, ``"A0Z"`` with order 0. ``axis``: index of the
    moving axis. ``component``: 0..2 for the translations X, Y, Z, 3..5 for the rotations A, B, C. A named tuple, because hundreds of terms
    are the key of what is kept for them (`layout_of`).
    """

    motion: str
    order: int
    axis: int
    component: int

    @property
    def name(self) -> str:
        """Name of the coefficient: ``EYX.3``, ``C0Y``."""
        return f"{self.motion}.{self.order}" if self.order else self.motion


SMOOTH_ORDER = 12
"""Highest Legendre order of a smooth error motion; higher orders describe its rough part (`rough_terms`)."""
ROUGH_ORDER = 36
"""Highest Legendre order of a translational error motion with its rough part: details of a twentieth of the stroke."""
ROUGH_ANGLE_ORDER = 24
"""Highest Legendre order of a rotational error motion with its rough part."""


@lru_cache(maxsize=1)
def rough_terms() -> tuple[Term, ...]:
    """Return the terms of the rough parts of the 18 error motions: orders above `SMOOTH_ORDER`."""
    highest = (ROUGH_ORDER, ROUGH_ANGLE_ORDER)
    return tuple(t for t in smooth_terms(ROUGH_ORDER) if SMOOTH_ORDER < t.order <= highest[t.component >= 3])


@lru_cache(maxsize=64)
def smooth_terms(order: int) -> tuple[Term, ...]:
    """Return all 18 order - 3 terms of the 21 error motions up to a Legendre order."""
    if order < 1:
        raise ValueError(f"Legendre order {order}: must be 1 or more")
    terms: list[Term] = []
    for a, axis in enumerate(DIRECTIONS):
        for c, motion in enumerate(motion_names(axis)):
            first = 2 if c < 3 and c != a else 1
            terms.extend(Term(motion, k, a, c) for k in range(first, order + 1))
    terms.extend(Term(name, 0, axis, comp) for name, axis, comp in (("C0Y", 1, 0), ("B0Z", 2, 0), ("A0Z", 2, 1)))
    return tuple(terms)


def term_values(terms: tuple[Term, ...], axes_mm: F2, stroke_mm: F2) -> F2:
    """Return the value of each term's function at commanded positions, without lever arms.

    Parameters
    ----------
    terms : tuple of Term
    axes_mm : array, shape (n, 3)
    stroke_mm : array, shape (3, 2)

    Returns
    -------
    array, shape (n, len(terms))
        Legendre polynomial (zero at the start of the stroke for positioning and angles); for squareness, the travel from the start of the
        stroke, mm, with the sign of docs/explanation/conventions.md.
    """
    layout = layout_of(terms)
    start, travel_mm = stroke_mm[:, :1], np.asarray(axes_mm).T - stroke_mm[:, :1]
    u = np.minimum(np.maximum(2.0 * travel_mm / (stroke_mm[:, 1:] - start) - 1.0, -1.0), 1.0)
    out = np.moveaxis(legendre.legvander(u, layout.highest), -1, 0).reshape(-1, u.shape[1])[layout.row]
    out -= layout.at_start[:, None]
    for i, axis, sign in layout.squareness:
        out[i] = sign * travel_mm[axis]
    return np.ascontiguousarray(out.T)


def term_motions(terms: tuple[Term, ...], coefficients: F1, axes_mm: F2, stroke_mm: F2) -> F3:
    """Return the error motions that coefficients of terms give at commanded positions, without lever arms.

    The result equals the products of `term_values` with the coefficients, in a tenth of the time: polynomials are evaluated once per axis.

    Parameters
    ----------
    coefficients : array, shape (len(terms),)
        mm or rad.
    axes_mm : array, shape (n, 3)
    stroke_mm : array, shape (3, 2)

    Returns
    -------
    array, shape (n, 3 axes X Y Z, 6)
        EX EY EZ (mm, squareness included, counted from the start of the stroke), EA EB EC (rad).
    """
    layout = layout_of(terms)
    square = [i for i, _, _ in layout.squareness]
    own = np.delete(np.arange(len(terms)), square)
    weight = np.zeros((3, layout.highest + 1, 6))
    (order, axis), component = np.divmod(layout.row[own], 3), layout.motion[own] % 6
    np.add.at(weight, (axis, order, component), coefficients[own])
    np.subtract.at(weight[:, 0], (axis, component), coefficients[own] * layout.at_start[own])
    start, travel_mm = stroke_mm[:, :1], np.asarray(axes_mm).T - stroke_mm[:, :1]
    u = np.minimum(np.maximum(2.0 * travel_mm / (stroke_mm[:, 1:] - start) - 1.0, -1.0), 1.0)
    out: F3 = np.empty((travel_mm.shape[1], 3, 6))
    for a in range(3):
        out[:, a] = legendre.legvander(u[a], layout.highest) @ weight[a]
    for i, a, sign in layout.squareness:
        out[:, a, terms[i].component] += sign * coefficients[i] * travel_mm[a]
    return out


@dataclass(frozen=True)
class TermLayout:
    """Indices that `term_values` needs for a tuple of terms, shape (terms,) each.

    ``motion``: index of the error motion, 6 axis + component. ``row``: row of the Legendre tables, 3 order + axis. ``at_start``: value at
    the start of the stroke, which is subtracted; zero for straightness. ``highest``: highest order. ``squareness``: (index of the term,
    axis, sign) of each squareness.
    """

    motion: np.ndarray[tuple[int, ...], np.dtype[np.intp]]
    row: np.ndarray[tuple[int, ...], np.dtype[np.intp]]
    at_start: F1
    highest: int
    squareness: tuple[tuple[int, int, float], ...]


@lru_cache(maxsize=64)
def layout_of(terms: tuple[Term, ...]) -> TermLayout:
    """Return the layout of these terms; it is cached."""
    straight = np.array([t.component < 3 and t.component != t.axis for t in terms], dtype=bool)
    return TermLayout(
        np.array([6 * t.axis + t.component for t in terms], dtype=np.intp),
        np.array([3 * t.order + t.axis for t in terms], dtype=np.intp),
        np.where(straight, 0.0, [(-1.0) ** t.order for t in terms]),
        max((t.order for t in terms), default=0),
        tuple((i, t.axis, 1.0 if t.motion == "B0Z" else -1.0) for i, t in enumerate(terms) if t.order == 0),
    )
