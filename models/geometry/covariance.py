"""Whether a matrix can be the covariance of parameters in mm and rad at all."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from abbe.models.arrays import F2

TOLERANCE = 1e-6
"""Of a correlation: covariances come out of files, where six or seven digits are usual."""


def checked_covariance(matrix: ArrayLike, size: int, what: str = "covariance") -> F2:
    """A covariance, made exactly symmetric.

    mm and rad differ by five orders, so the correlations are judged and not the raw numbers. A parameter whose variance is zero is
    certain: nothing can be correlated with it.

    Parameters
    ----------
    matrix : array, shape (size, size)
        Variances on the diagonal, in squares of the parameters' units.
    size : int
        Number of parameters.
    what : str
        Its name in error messages.

    Returns
    -------
    array, shape (size, size)

    Raises
    ------
    ValueError
        Another shape, text or truth values in place of numbers, a number that is not finite, a negative variance, a covariance with a
        parameter of variance zero or above what the two variances allow, no symmetry, or a combination of parameters whose variance
        would be negative (the last three beyond `TOLERANCE` of a correlation).
    """
    raw = np.asarray(matrix)
    if raw.dtype.kind not in "fiu":
        raise ValueError(f"{what}: expected rows of numbers, got {raw.dtype}")
    c: F2 = raw.astype(np.float64)
    if c.shape != (size, size):
        raise ValueError(f"{what}: {size} parameters need shape ({size}, {size}), got {c.shape}")
    if not np.isfinite(c).all():
        raise ValueError(f"{what}: expected finite numbers")
    variance = np.diag(c)
    if (variance < 0.0).any():
        raise ValueError(
            f"{what}, row {int(np.argmax(variance < 0.0)) + 1}: the variance is negative; expected squares of standard uncertainties"
        )
    certain = (variance == 0.0) & ((c != 0.0).any(axis=0) | (c != 0.0).any(axis=1))
    if certain.any():
        raise ValueError(f"{what}, row {int(np.argmax(certain)) + 1}: the variance is zero, so the whole row and column must be")
    _check_correlations(c, np.sqrt(np.where(variance > 0.0, variance, 1.0)), what)
    half: F2 = 0.5 * c
    return half + half.T  # each half first: the sum of two large numbers would be infinite


def _check_correlations(c: F2, spread: F2, what: str) -> None:
    with np.errstate(all="ignore"):  # what overflows is far above 1, and refused as that
        scaled = c / spread[:, None] / spread
        if (np.abs(scaled - scaled.T) > TOLERANCE).any():
            raise ValueError(f"{what}: it is not symmetric: row i, column j must hold the same number as row j, column i")
        impossible = not (np.abs(scaled) <= 1.0 + TOLERANCE).all()
    if impossible or (scaled.size and np.linalg.eigvalsh(scaled).min() < -TOLERANCE):
        raise ValueError(f"{what}: no covariance: some combination of the parameters would have a negative variance")
