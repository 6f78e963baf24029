"""Directions of travel: no axis reverses because two equal positions differ in their last digit."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from abbe.models.geometry.chain import travel_sign
from abbe.models.paths import DIAGONALS, diagonal_ends, step_diagonal


@given(st.lists(st.floats(300.0, 1200.0), min_size=3, max_size=3), st.integers(2, 30), st.sampled_from(sorted(DIAGONALS)))
def test_on_a_step_diagonal_every_axis_reverses_once_at_the_far_end(length_mm, steps, name):
    box = np.stack([np.zeros(3) + 10.0, np.array(length_mm) - 10.0], axis=1)
    path = step_diagonal(*diagonal_ends(box, name), steps, "XYZ")
    sign = travel_sign(path)
    there = np.array(DIAGONALS[name], dtype=float)
    half = len(path) // 2
    assert (sign[:half] == there).all()
    assert (np.abs(np.diff(sign, axis=0)).sum(axis=0) == 2.0).all()
    assert (sign[-1] == -there).all()


def test_a_rounding_error_is_no_motion_and_a_nanometre_is_one():
    def signs(*x_mm: float) -> list[float]:
        return travel_sign(np.column_stack([x_mm, np.zeros((len(x_mm), 2))]))[:, 0].tolist()

    assert signs(0.0, 931.0, 931.0 - 1e-13, 931.0) == [1.0, 1.0, 1.0, 1.0]
    assert signs(0.0, 931.0, 931.0 - 1e-6) == [1.0, 1.0, -1.0]
    assert signs(5.0, 5.0, 5.0) == [0.0, 0.0, 0.0]
