"""Exact integration of piecewise polynomials."""

from __future__ import annotations

import numpy as np
from numpy.polynomial import legendre

from abbe.models.arrays import F1


def nodes(stroke_mm: tuple[float, float], breaks_mm: F1, count: int) -> tuple[F1, F1]:
    """Gauss-Legendre nodes and weights over a stroke, piece by piece.

    Parameters
    ----------
    stroke_mm : (smaller, larger)
    breaks_mm : array
        Where pieces meet, in any order; those outside the stroke do not matter.
    count : int
        Nodes per piece: integrals of polynomials up to degree 2 count - 1 are exact.

    Returns
    -------
    two arrays, shape (pieces * count,)
        Positions and weights in mm; the weights add up to the length of the stroke.
    """
    lo, hi = stroke_mm
    inner = np.unique(breaks_mm[(breaks_mm > lo) & (breaks_mm < hi)])
    edges = np.concatenate([[lo], inner, [hi]])
    u, w = legendre.leggauss(count)
    half = 0.5 * np.diff(edges)[:, None]
    middle = 0.5 * (edges[1:] + edges[:-1])[:, None]
    return (middle + half * u).ravel(), (half * w).ravel()
