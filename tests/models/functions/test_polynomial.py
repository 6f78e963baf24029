"""Straight lines against numpy's own least squares."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from abbe.models.functions.polynomial import slope_through_origin, straight_line

POINTS = st.lists(st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)), min_size=2, max_size=30, unique_by=lambda p: round(p[0], 2))


@given(POINTS)
def test_same_line_as_a_general_solver(points):
    x, y = np.array(points).T
    slope, intercept = straight_line(x, y)
    expected, *_ = np.linalg.lstsq(np.stack([x, np.ones_like(x)], axis=1), y, rcond=None)
    assert slope * x + intercept == pytest.approx(expected[0] * x + expected[1], rel=1e-6, abs=1e-6 * (1 + np.abs(y).max()))
    if (x @ x) > 1e-6:
        assert slope_through_origin(x, y) == pytest.approx(np.linalg.lstsq(x[:, None], y, rcond=None)[0][0], rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("fit", [straight_line, slope_through_origin])
def test_what_is_no_line_is_refused(fit):
    with pytest.raises(ValueError, match="at least"):
        fit(np.zeros(3), np.ones(3))
    with pytest.raises(ValueError, match="vectors of one length"):
        fit(np.zeros(3), np.ones(2))
    with pytest.raises(ValueError, match="vectors of one length"):
        fit(np.zeros(0), np.zeros(0))
