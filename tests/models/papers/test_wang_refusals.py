"""What the functions about Wang's step diagonal refuse, in one clear line."""

import numpy as np
import pytest

from abbe.models.functions.monomials import ErrorArrays, monomials
from abbe.models.papers.wang.model import (
    diagonal_beam,
    displacement_eq11,
    monomial_field,
    position_error_eq9,
    projection_factors,
    step_readings_mm,
)
from abbe.models.papers.wang.squareness import abbe_and_spurious_eq7, closure_of_angles_mm
from abbe.models.paths import DIAGONALS, diagonal_ends, straight_line
from abbe.models.solvers.step_diagonal import closure_mm, increments, project_eq6, squareness_contrast, u_wang_four, wang_eq7, wang_four


@pytest.mark.parametrize("order", ["XXZ", "XY", "", "xyz", "XYZX"])
def test_a_step_order_that_leaves_an_axis_out_is_refused(order):
    with pytest.raises(ValueError, match="once each"):
        increments({"ppp": np.arange(7.0)}, order)


@pytest.mark.parametrize(
    ("readings", "said"),
    [
        ({}, "no diagonal"),
        ({"nnn": np.arange(7.0)}, "'nnn'"),
        ({"ppp": np.zeros(0)}, "3 n"),
        ({"ppp": np.zeros(1)}, "3 n"),
        ({"ppp": np.zeros(6)}, "3 n"),
        ({"ppp": np.zeros((7, 2))}, "3 n"),
    ],
)
def test_readings_that_are_no_step_diagonal_are_refused(readings, said):
    with pytest.raises(ValueError, match=said):
        increments(readings)


def test_steps_find_their_axis_whatever_the_order():
    q = increments({"npp": np.array([0.0, 1.0, 3.0, 6.0, 16.0, 36.0, 66.0])}, "ZXY")["npp"]  # Z X Y Z X Y
    assert q == pytest.approx(np.array([[-20.0, -2.0], [3.0, 30.0], [1.0, 10.0]]))


INC, ZERO = np.array([80.0, 50.0, 40.0]), np.zeros(3)
Q = {name: np.zeros((3, 4)) for name in DIAGONALS}
TOTALS = dict.fromkeys(DIAGONALS, 1e-3)


@pytest.mark.parametrize("inc", [np.array([80.0, 0.0, 40.0]), np.array([80.0, -1.0, 40.0]), np.array([80.0, np.nan, 40.0]), np.ones(2)])
@pytest.mark.parametrize(
    "call",
    [
        lambda inc: wang_eq7(Q, inc),
        lambda inc: wang_four(Q, inc),
        lambda inc: u_wang_four(inc, 4, 1e-4),
        lambda inc: project_eq6(np.zeros((3, 3, 4)), inc),
        lambda inc: projection_factors(inc),
        lambda inc: diagonal_beam(inc, "ppp"),
        lambda inc: abbe_and_spurious_eq7(4, inc, ZERO, ZERO),
        lambda inc: closure_of_angles_mm(inc, ZERO),
        lambda inc: squareness_contrast(TOTALS, inc),
    ],
)
def test_increments_and_travels_must_be_three_positive_numbers(call, inc):
    with pytest.raises(ValueError, match=r"three positive numbers|must have shape"):
        call(inc)


def test_all_four_diagonals_are_needed():
    three = {name: Q[name] for name in ("ppp", "npp", "pnp")}
    for call in (lambda q: wang_eq7(q, INC), lambda q: wang_four(q, INC), closure_mm):
        with pytest.raises(ValueError, match="ppn missing"):
            call(three)
        with pytest.raises(ValueError, match="different shapes"):
            call(three | {"ppn": np.zeros((3, 5))})
    with pytest.raises(ValueError, match="ppn missing"):
        squareness_contrast({"ppp": 0.0, "npp": 0.0, "pnp": 0.0}, INC)
    with pytest.raises(ValueError, match="uncertainty"):
        squareness_contrast(TOTALS, INC, -1e-4)


def test_a_mirror_along_the_beam_has_no_reading():
    beam = diagonal_beam(INC, "ppp")
    along = np.cross(beam, [0.0, 0.0, 1.0])
    with pytest.raises(ValueError, match="parallel to the beam"):
        step_readings_mm(np.zeros((4, 3)), np.zeros((4, 3)), beam, along)
    with pytest.raises(ValueError, match="parallel to the beam"):
        step_readings_mm(np.zeros((4, 3)), np.zeros((4, 3)), beam, ZERO)


def test_unknown_diagonals_and_lines_of_one_position_are_refused():
    with pytest.raises(ValueError, match="'nnn'"):
        diagonal_ends(np.array([[0.0, 1.0]] * 3), "nnn")
    with pytest.raises(ValueError, match="'nnn'"):
        diagonal_beam(INC, "nnn")
    with pytest.raises(ValueError, match="box"):
        diagonal_ends(np.zeros((2, 2)), "ppp")
    for n in (1, 0, -3):
        with pytest.raises(ValueError, match="positions"):
            straight_line(ZERO, INC, n)


def test_errors_of_other_positions_are_not_broadcast():
    errors = ErrorArrays(np.zeros((30, 3, 3)), np.zeros((30, 3, 3)), ZERO)
    for call in (position_error_eq9, displacement_eq11):
        with pytest.raises(ValueError, match="30 positions"):
            call(errors, np.ones((1, 3)))
    assert monomial_field(monomials(1), np.ones((2, 3)), INC).shape == (2, 3, 15)
