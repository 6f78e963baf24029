"""A correction takes the error away: what every kind of table adds has the opposite sign of what the machine does, in figures by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from abbe.models.compensation.achievable import cross_only, enough_for_the_field, motion_tables, positioning_only, squareness_tables
from abbe.models.compensation.grid import grid_table
from abbe.models.compensation.nine_tables import nine_tables
from abbe.models.compensation.tables import quantise
from abbe.models.solvers.joint import JointSolution, solve_joint
from tests.models.solvers.truth import FLOOR, MACHINE, SIGMA, Truth

COUNTS = (3, 3, 3)
LOW, HIGH = MACHINE.stroke_mm.T
TOO_FAR_MM = 0.060
"""X goes so much farther than it is told, over its whole stroke; half of it is the first Legendre coefficient, in mm."""


@pytest.fixture(scope="module")
def solved() -> JointSolution:
    return solve_joint(MACHINE, Truth(2).campaign(), order=2, sigma_mm=SIGMA, floor_mm=FLOOR)


def only(solution: JointSolution, name: str, value: float) -> JointSolution:
    theta = np.zeros_like(solution.estimate.theta)
    theta[solution.estimate.names.index(name)] = value
    return replace(solution, estimate=replace(solution.estimate, theta=theta))


def added_um(table, axis: int) -> np.ndarray:
    """What the table adds at the far end of an axis, against its near end, µm."""
    ends = np.array([LOW, np.where(np.arange(3) == axis, HIGH, LOW)])
    near, far = table.correction_at(ends)
    return 1e3 * (far - near)


KINDS = {
    "nine": lambda s: nine_tables(s, COUNTS),
    "nine, rounded": lambda s: quantise(nine_tables(s, COUNTS), 1e-4),
    "positioning": lambda s: positioning_only(nine_tables(s, COUNTS)),
    "squareness": lambda s: squareness_tables(s, COUNTS),
    "single motions": lambda s: motion_tables(s, COUNTS, enough_for_the_field(s), any_tool=False),
}


@pytest.mark.parametrize("kind", KINDS)
def test_an_axis_that_goes_too_far_is_told_to_go_less_far(solved, kind):
    table = KINDS[kind](only(solved, "EXX.1", TOO_FAR_MM / 2))
    assert added_um(table, 0) == pytest.approx([-60.0, 0.0, 0.0], abs=0.2)


def test_an_axis_that_drifts_aside_is_led_back(solved):
    table = cross_only(nine_tables(only(solved, "EYX.2", 0.010), COUNTS))
    middle = np.array([LOW, np.where(np.arange(3) == 0, (LOW + HIGH) / 2, LOW)])
    ends, bow = table.correction_at(middle)[:, 1]
    # the second Legendre polynomial is 1 at both ends and -1/2 in the middle: there Y is 15 µm too low, and is lifted by as much
    assert 1e3 * (bow - ends) == pytest.approx(15.0, abs=0.2)


def test_the_grid_shortens_what_is_too_long(solved):
    """Its frame is free: only the distance along X counts."""
    table = grid_table(only(solved, "EXX.1", TOO_FAR_MM / 2), COUNTS)
    assert added_um(table, 0)[0] == pytest.approx(-60.0, abs=0.2)
