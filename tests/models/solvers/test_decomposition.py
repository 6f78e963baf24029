"""Singular values come also where LAPACK's fast routine gives up."""

import numpy as np
import pytest
from scipy import linalg

from abbe.models.solvers import least_squares as decomposition
from abbe.models.solvers.least_squares import singular_values, svd


@pytest.fixture(params=[True, False], ids=["fast", "fast one fails"])
def lapack(request, monkeypatch):
    real = linalg.svd

    def gives_up(a, *, lapack_driver="gesdd", **more):
        if lapack_driver == "gesdd":
            raise linalg.LinAlgError("SVD did not converge")
        return real(a, lapack_driver=lapack_driver, **more)

    if not request.param:
        monkeypatch.setattr(decomposition.scipy.linalg, "svd", gives_up)


@pytest.mark.parametrize("shape", [(40, 12), (12, 40), (7, 7)])
def test_the_product_is_the_matrix(lapack, shape):
    rng = np.random.default_rng(3)
    a = rng.normal(size=shape)
    a[:, -1] = a[:, 0]  # dependent columns: what the rank is asked about
    for full in (False, True):
        u, s, vt = svd(a, full_matrices=full)
        k = s.size
        assert np.allclose(u[:, :k] * s @ vt[:k], a, atol=1e-13)
        assert u.shape == (shape[0], shape[0] if full else k)
    assert np.allclose(singular_values(a), s, atol=1e-13)
    assert s[min(shape) - 1] < 1e-13 * s[0] or shape[0] < shape[1]


def test_what_is_no_number_is_refused_and_not_decomposed(lapack):
    with pytest.raises(ValueError, match="NaN"):
        svd(np.full((3, 3), np.nan))
