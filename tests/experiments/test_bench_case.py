"""The bench's agreement step can fail: every table and every squareness of its machine matters to its result."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from abbe.models.geometry.chain import deviation_mm, exact_deviation_mm
from tests.experiments.bench.__main__ import SECOND_ORDER_MM
from tests.experiments.bench.case import CASES, make
from tests.experiments.kernel import kernel

POINTS = 20_000


@pytest.mark.parametrize("name", CASES)
def test_leaving_out_any_of_the_21_errors_shows_far_above_what_agreement_allows(name):
    case = make(name, POINTS)
    points = case.points[:: max(1, len(case.points) // POINTS)]
    whole, smallest = kernel.scattered(case.tables, points), np.inf
    for k in range(21):
        tables, square = [t.copy() for t in case.tables.tables], case.tables.squareness_rad.copy()
        if k < 18:
            tables[k // 6][:, k % 6] = 0.0
        else:
            square[k - 18] = 0.0
        without = kernel.scattered(replace(case.tables, tables=tuple(tables), squareness_rad=square), points)
        smallest = min(smallest, np.abs(without - whole).max())
    assert smallest > 10 * SECOND_ORDER_MM


def test_what_exact_kinematics_adds_stays_within_what_agreement_allows():
    case = make("scattered", POINTS)
    motions = case.tables.motions(case.points)
    machine = case.tables.machine
    first, exact = deviation_mm(machine, case.points, motions), exact_deviation_mm(machine, case.points, motions)
    assert 1e-7 < np.abs(exact - first).max() < SECOND_ORDER_MM


def test_the_even_look_up_that_peers_are_helped_with_finds_the_tables_values():
    case = make("scattered", POINTS)
    np.testing.assert_allclose(case.even_look_up()(), case.table_values(), rtol=0, atol=1e-16)
