"""The 20 cubic monomials of the response surface, their order in Kwon's (27), and the ten that one plane can carry."""

from __future__ import annotations

import numpy as np
from numpy.polynomial import polynomial

from abbe.models.arrays import F1, F2

Exponents = tuple[int, int, int]

CUBIC: tuple[Exponents, ...] = (
    *((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (2, 0, 0), (0, 2, 0), (0, 0, 2)),
    *((1, 1, 1), (2, 1, 0), (2, 0, 1), (1, 2, 0), (1, 0, 2), (0, 2, 1), (0, 1, 2), (3, 0, 0), (0, 3, 0), (0, 0, 3)),
)
"""Exponents of X, Y, Z for beta_0 .. beta_19; beta_16 belongs to Y Z^2, the paper prints Z Y^2 twice (math.md 3, K (27))."""

IN_PLANE: tuple[Exponents, ...] = tuple(
    (i, j, 0) for i, j in ((0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (0, 2), (2, 1), (1, 2), (3, 0), (0, 3))
)
"""The ten monomials of X and Y."""


def term_name(term: Exponents) -> str:
    """As people write it: ``1``, ``X``, ``X Y^2``."""
    parts = [f"{letter}^{k}" if k > 1 else letter for letter, k in zip("XYZ", term, strict=True) if k]
    return " ".join(parts) or "1"


def regressors(points_mm: F2, terms: tuple[Exponents, ...]) -> F2:
    """Values of monomials at points: the matrix P_e that (28) needs (the paper prints [X, Y, Z] only, math.md 3, K (28)).

    Parameters
    ----------
    points_mm : array, shape (n, 3)
    terms : tuple of (i, j, k)

    Returns
    -------
    array, shape (n, len(terms))
    """
    exponents = np.asarray(terms, dtype=np.int64).reshape(-1, 3)
    powers = np.asarray(points_mm, dtype=np.float64)[:, None, :] ** np.arange(4)[:, None]
    x, y, z = (powers[:, exponents[:, axis], axis] for axis in range(3))
    values: F2 = x * y * z
    return values


def term_matrix(terms: tuple[Exponents, ...], shift_mm: F1, scale_mm: F1) -> F2:
    """Matrix from coefficients of centred and scaled monomials to those of raw ones.

    With u = (x - shift) / scale, a polynomial sum c_t u^t equals sum (M c)_s x^s over the same terms, for a set of terms that contains
    every divisor of each of its terms (CUBIC, IN_PLANE and CUBIC up to a power of Z do).

    Parameters
    ----------
    terms : tuple of (i, j, k)
    shift_mm, scale_mm : arrays, shape (3,)

    Returns
    -------
    array, shape (len(terms), len(terms))
    """
    row = {t: r for r, t in enumerate(terms)}
    out = np.zeros((len(terms), len(terms)))
    for column, term in enumerate(terms):
        x, y, z = (polynomial.polypow([-c / s, 1.0 / s], k) for k, c, s in zip(term, shift_mm, scale_mm, strict=True))
        for i, j, k in np.ndindex(x.size, y.size, z.size):
            out[row[(i, j, k)], column] += x[i] * y[j] * z[k]
    return out
