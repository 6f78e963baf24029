"""Tables of a part of the strokes: they take out what is known there, hold their ends beyond, and leave the third axis alone."""

from __future__ import annotations

import numpy as np
import pytest

from abbe.models.compensation.plane import partial_tables
from abbe.models.machine import Machine

MACHINE = Machine("w-X-Y-b-Z-t", np.array([[0.0, 600.0], [0.0, 500.0], [0.0, 450.0]]), np.zeros((3, 3)), np.zeros(3))
BOX = np.array([[100.0, 400.0], [150.0, 350.0], [200.0, 200.0]])
COUNTS = (25, 21, 19)


def error_mm(points: np.ndarray) -> np.ndarray:
    """A field that is a sum of functions of one axis, in the plane."""
    u, v = points[:, 0] - 250.0, points[:, 1] - 250.0
    return np.stack([4e-5 * u - 2e-5 * v + 3e-7 * v**2, -2e-5 * u - 6e-5 * v + 1e-7 * u**2, np.full(len(u), np.nan)], axis=1)


def known(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return error_mm(points), np.full(points.shape, 2e-4)


def test_they_take_out_what_is_known():
    tables, promised = partial_tables(MACHINE, (BOX,), known, COUNTS)
    assert promised.before_mm > 5e-3
    assert promised.after_mm < 0.1 * promised.before_mm, "corners between the tables' points are left"
    assert promised.u_model_mm == pytest.approx(2e-4 * np.sqrt(2.0))
    assert tables.u_mm[0][5, 0] == pytest.approx(2e-4)


def test_they_hold_their_ends_begin_at_zero_and_leave_the_third_axis():
    tables, _ = partial_tables(MACHINE, (BOX,), known, COUNTS)
    x = tables.correction_mm[0]
    assert (x[tables.position_mm[0] <= 100.0] == 0.0).all()
    assert np.ptp(x[tables.position_mm[0] >= 400.0], axis=0) == pytest.approx(0.0)
    assert not tables.correction_mm[2].any()
    assert not any(t[:, 2].any() for t in tables.correction_mm)


def test_of_two_heights_they_are_the_best_for_both():
    """The field turns with the height, as a pitching axis does: tables that act at every height take out its mean."""
    other = BOX + np.array([[0.0], [0.0], [200.0]])

    def known_at(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        value = error_mm(points)
        value[:, 0] += 1e-4 * (points[:, 2] - 300.0) / 100.0 * (points[:, 0] - 250.0)
        return value, np.full(points.shape, 2e-4)

    tables, promised = partial_tables(MACHINE, (BOX, other), known_at, COUNTS)
    one, single = partial_tables(MACHINE, (BOX,), known, COUNTS)
    for a in range(3):
        assert tables.correction_mm[a] == pytest.approx(one.correction_mm[a], abs=1e-9)
    assert promised.after_mm > 5e-3 > 10.0 * single.after_mm, "what differs between the heights stays"


def test_in_a_volume_all_three_axes_correct_all_sensed_directions():
    box = np.array([[100.0, 400.0], [150.0, 350.0], [100.0, 300.0]])

    def known_at(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u, v, w = (points - [250.0, 250.0, 200.0]).T
        return np.stack([4e-5 * u + 3e-7 * w**2, -6e-5 * v, 5e-5 * w + 1e-7 * u**2], axis=1), np.full(points.shape, 2e-4)

    tables, promised = partial_tables(MACHINE, (box,), known_at, COUNTS)
    assert promised.after_mm < 0.1 * promised.before_mm
    assert np.ptp(tables.correction_mm[2][:, 0]) == pytest.approx(3e-3, rel=0.1)
