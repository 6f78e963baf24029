"""Singular values and vectors that always come: the fast routine of LAPACK now and then gives up on matrices that the slower one takes."""

from __future__ import annotations

import numpy as np
from scipy import linalg

from abbe.models.arrays import F1, F2


def svd(a: F2, *, full_matrices: bool = False) -> tuple[F2, F1, F2]:
    """Singular value decomposition a = u @ diag(s) @ vt.

    Divide and conquer (gesdd) is several times faster and fails on some matrices of exactly dependent columns, whose rounding decides; then
    QR iteration (gesvd) does it, whose convergence does not depend on rounding.

    Raises
    ------
    ValueError
        Something in the matrix is no finite number.
    """
    try:
        u, s, vt = linalg.svd(a, full_matrices=full_matrices, check_finite=False)
    except linalg.LinAlgError:
        u, s, vt = linalg.svd(a, full_matrices=full_matrices, lapack_driver="gesvd")
    return np.asarray(u), np.asarray(s), np.asarray(vt)


def singular_values(a: F2) -> F1:
    """Singular values alone, largest first; raises as `svd`."""
    try:
        return np.asarray(linalg.svd(a, compute_uv=False, check_finite=False))
    except linalg.LinAlgError:
        return np.asarray(linalg.svd(a, compute_uv=False, lapack_driver="gesvd"))
