"""Rules by construction (straightness, angles, positioning) and conversions with their error."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.integrate import quad

from abbe.models.functions.bspline import BSpline, clamped_knots
from abbe.models.functions.legendre import Legendre
from abbe.models.functions.motions import as_angle, as_straightness, least_squares_line
from abbe.models.functions.polynomial import Polynomial
from abbe.models.functions.table import Table
from tests.experiments.mathematics.convert import convert, fit, form

LO, HI = -120.0, 580.0
LENGTH = HI - LO
SMOOTH = ("polynomial", "legendre", "bspline")
KINDS = (*SMOOTH, "linear", "cubic")


def draw(kind: str, seed: int):
    rng = np.random.default_rng(seed)
    if kind == "polynomial":
        return Polynomial(rng.normal(size=5) / LENGTH ** np.arange(5), LO)
    if kind == "legendre":
        return Legendre(rng.normal(size=6), (LO, HI))
    if kind == "bspline":
        return BSpline(clamped_knots((LO, HI), 7, 3), rng.normal(size=10), 3)
    position = LO + LENGTH * np.concatenate([[0.0], (np.arange(1, 8) + rng.uniform(-0.4, 0.4, 7)) / 8.0, [1.0]])
    return Table(position, rng.normal(size=9), kind)


def integral(f, power: int) -> float:
    """Of f(x) u^power over the stroke, u in -1..1, in units of the stroke's length, piece by piece."""
    edges = np.unique(np.concatenate([[LO, HI], f.breaks_mm]))
    pieces = [quad(lambda x: float(f(x)) * ((x - 0.5 * (LO + HI)) / (0.5 * LENGTH)) ** power, a, b) for a, b in pairwise(edges)]
    return sum(value for value, _ in pieces) / LENGTH


@pytest.mark.parametrize("kind", SMOOTH)
@given(seed=st.integers(0, 10_000), offset=st.floats(-5, 5), slope=st.floats(-1e-2, 1e-2))
@settings(max_examples=15, deadline=None)
def test_straightness_has_neither_offset_nor_slope_and_loses_nothing(kind, seed, offset, slope):
    f = draw(kind, seed).plus_line(offset, slope)
    ruled = as_straightness(f, (LO, HI))
    scale = np.abs(f(np.linspace(LO, HI, 50))).max()
    assert abs(integral(ruled.function, 0)) < 3e-15 * scale
    assert abs(3.0 * integral(ruled.function, 1)) < 3e-15 * scale
    x = np.linspace(LO, HI, 31)
    assert_allclose(ruled.function(x) + ruled.offset_mm + ruled.slope * x, f(x), rtol=0, atol=1e-14 * scale)
    assert type(ruled.function) is type(f)


@pytest.mark.parametrize("kind", SMOOTH)
@given(seed=st.integers(0, 10_000))
@settings(max_examples=15, deadline=None)
def test_the_removed_line_is_the_one_that_integration_gives(kind, seed):
    f = draw(kind, seed)
    slope, value = least_squares_line(f, (LO, HI))
    assert_allclose(slope, 3.0 * integral(f, 1) / (0.5 * LENGTH), rtol=1e-10, atol=1e-15)
    assert_allclose(value + slope * 0.5 * (LO + HI), integral(f, 0), rtol=1e-10, atol=1e-13)


@pytest.mark.parametrize("kind", ["linear", "cubic"])
@given(seed=st.integers(0, 10_000))
@settings(max_examples=15, deadline=None)
def test_a_table_loses_the_line_through_its_own_positions(kind, seed):
    f = draw(kind, seed)
    ruled = as_straightness(f, (LO, HI))
    slope, offset = np.polyfit(f.position_mm, f.value, 1)
    assert_allclose([ruled.slope, ruled.offset_mm], [slope, offset], rtol=1e-9, atol=1e-13)
    rest, u = ruled.function.value, (f.position_mm - LO) / LENGTH
    assert abs(rest.mean()) < 1e-15 * np.abs(f.value).max()
    assert abs(rest @ (u - u.mean())) / ((u - u.mean()) @ (u - u.mean())) < 1e-15 * np.abs(f.value).max() * 3.0


def test_of_a_table_only_positions_inside_the_stroke_count():
    f = Table([0.0, 10.0, 20.0, 30.0, 40.0], [7.0, 1.0, 2.0, 3.0, -7.0])
    ruled = as_straightness(f, (10.0, 30.0))
    assert_allclose([ruled.slope, ruled.offset_mm], [0.1, 0.0], atol=1e-15)
    assert_allclose(ruled.function([10.0, 20.0, 30.0]), 0.0, atol=1e-15)


def test_straightness_of_a_legendre_series_is_its_terms_from_two_on():
    ruled = as_straightness(Legendre([3.0, 1.4, 0.5, -0.2], (LO, HI)), (LO, HI))
    assert_allclose(ruled.function.coefficients, [0.0, 0.0, 0.5, -0.2], atol=2e-16)
    assert_allclose([ruled.slope, ruled.offset_mm], [1.4 / 350.0, 3.0 - 1.4 / 350.0 * 230.0], rtol=1e-13)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("at", [LO, 13.7, HI])
def test_angles_are_zero_at_their_reference(kind, at):
    f = draw(kind, 4)
    x = np.linspace(LO, HI, 31)
    ruled = as_angle(f, at)
    assert abs(float(ruled.function(at))) <= 1e-15 * np.abs(f(x)).max()
    assert ruled.constant == pytest.approx(float(f(at)), rel=1e-14)
    assert_allclose(ruled.function(x) + ruled.constant, f(x), rtol=0, atol=1e-14)


def test_a_rule_outside_the_domain_is_refused():
    f = Legendre([1.0, 2.0], (0.0, 100.0))
    with pytest.raises(ValueError, match="stroke 0 to 101 mm goes beyond the function's domain, 0 to 100 mm"):
        as_straightness(f, (0.0, 101.0))
    with pytest.raises(ValueError, match="reference_mm = -1 lies outside"):
        as_angle(f, -1.0)
    with pytest.raises(ValueError, match="fewer than two positions between 1 and 2 mm"):
        as_straightness(Table([0.0, 10.0], [1.0, 2.0]), (1.0, 2.0))
    with pytest.raises(ValueError, match="smaller, larger"):
        as_straightness(f, (50.0, 50.0))


# --- conversion ----------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("origin", [LO, 0.0, 200.0])
@given(seed=st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_polynomial_to_legendre_and_back_is_exact(origin, seed):
    rng = np.random.default_rng(seed)
    f = Polynomial(1e-2 * rng.normal(size=6) / LENGTH ** np.arange(6), origin)
    there = convert(f, "legendre", stroke_mm=(LO, HI))
    back = convert(there.function, Polynomial(np.zeros(6), origin))
    assert there.function.degree == 5
    scale = np.abs(f(np.linspace(LO, HI, 50))).max()
    assert there.max_error < 1e-14 * scale
    assert back.max_error < 1e-14 * scale
    assert_allclose(back.function.coefficients * LENGTH ** np.arange(6), f.coefficients * LENGTH ** np.arange(6), rtol=0, atol=3e-14)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("to", ["polynomial", "legendre", "bspline", "table", "cubic table"])
def test_reported_error_is_the_one_that_is_there(kind, to):
    f = draw(kind, 11)
    name = to.split()[-1]
    order = {"polynomial": 6, "legendre": 6, "bspline": 3, "table": 1, "cubic table": 3}[to]
    done = convert(f, name, stroke_mm=(LO, HI), order=order, pieces=13)
    x = np.linspace(LO, HI, 40_001)
    off = np.abs(done.function(x) - f(x))
    assert off.max() <= done.max_error * 1.001 + 1e-14
    assert off.max() >= 0.99 * done.max_error - 1e-14
    assert done.rms_error == pytest.approx(np.sqrt(np.mean(off**2)), rel=0.02, abs=1e-14)
    assert abs(float(f(done.at_mm) - done.function(done.at_mm))) == done.max_error


def test_what_the_new_kind_can_hold_is_exact():
    cubic = Polynomial([1e-3, -2e-5, 3e-8, 4e-11], 50.0)
    assert convert(cubic, "bspline", stroke_mm=(LO, HI), pieces=6).max_error < 1e-16
    assert convert(cubic, "table", stroke_mm=(LO, HI), pieces=6, order=3).max_error < 1e-16
    table = draw("linear", 2)
    knots = np.concatenate([[LO], table.position_mm, [HI]])
    assert convert(table, BSpline(knots, np.zeros(table.value.size), 1)).max_error < 2e-15
    smooth = draw("cubic", 2)
    knots = np.concatenate([[LO] * 3, smooth.position_mm, [HI] * 3])
    assert convert(smooth, BSpline(knots, np.zeros(smooth.value.size + 2), 3)).max_error < 1e-13
    assert convert(smooth, Table(smooth.position_mm, np.zeros(9), "cubic")).max_error < 3e-15


def test_a_bump_narrower_than_the_steps_of_the_comparison_is_seen():
    bump = BSpline([LO] * 3 + [200.0] * 2 + [200.1] * 2 + [HI] * 3, [0, 0, 0, 1, 0, 0, 0], 2)
    done = convert(bump, Table([LO, 200.0, 200.1, HI], np.zeros(4)))
    assert done.max_error == pytest.approx(0.5)
    assert done.at_mm == pytest.approx(200.05)


def test_error_of_a_table_falls_with_the_square_or_fourth_power_of_its_step():
    f = Polynomial([0.0, 0.0, 0.0, 0.0, 1.0 / LENGTH**4], LO)
    for order, power in ((1, 2), (3, 4)):
        errors = [convert(f, "table", stroke_mm=(LO, HI), pieces=n, order=order).max_error for n in (40, 80)]
        assert np.log2(errors[0] / errors[1]) == pytest.approx(power, abs=0.25)


@pytest.mark.parametrize("kind", ["polynomial", "legendre"])
def test_a_lower_order_is_the_best_one(kind):
    """Nothing of the same order is nearer in the mean square: the rest is orthogonal to all that the kind can hold."""
    f = draw("bspline", 9)
    g = convert(f, kind, order=3).function
    for k in range(4):
        edges = np.unique(f.breaks_mm)
        rest = sum(quad(lambda x, k=k: float(f(x) - g(x)) * ((x - LO) / LENGTH) ** k, a, b)[0] for a, b in pairwise(edges))
        assert abs(rest) / LENGTH < 1e-13


@pytest.mark.parametrize(
    ("kind", "order", "pieces"), [("polynomial", 4, None), ("legendre", 4, None), ("bspline", 3, 5), ("table", 1, 8), ("table", 3, 8)]
)
def test_samples_of_a_kind_give_it_back_and_noise_is_averaged(kind, order, pieces):
    rng = np.random.default_rng(5)
    shape = form(kind, (LO, HI), order, pieces)
    scale = LENGTH ** np.arange(5) if kind == "polynomial" else np.ones(shape.parameters.size)
    truth = shape.with_parameters(rng.normal(size=shape.parameters.size) / scale)
    x = rng.permutation(np.linspace(LO, HI, 400))
    found = fit(x, truth(x), kind, order=order, pieces=pieces)
    assert found.max_error < 1e-12
    assert_allclose(found.function.parameters * scale, truth.parameters * scale, rtol=1e-8, atol=1e-10)
    noisy = fit(x, truth(x) + rng.normal(scale=0.1, size=x.size), kind, order=order, pieces=pieces)
    assert 0.08 < noisy.rms_error < 0.11
    assert np.sqrt(np.mean((noisy.function(x) - truth(x)) ** 2)) < 0.1 * np.sqrt(12.0 / 400.0) * 1.8


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: convert(Polynomial([1.0]), "legendre"), r"stroke_mm: expected \[smaller, larger\]"),
        (lambda: convert(draw("linear", 1), "legendre"), "legendre: order must be 0 or more, got None"),
        (lambda: convert(draw("linear", 1), "bspline"), "bspline: pieces must be 1 or more, got None"),
        (lambda: convert(draw("linear", 1), "table", pieces=4, order=2), "order 1 is linear, 3 is cubic, got 2"),
        (lambda: convert(draw("linear", 1), "spline", order=3), "kind 'spline', expected 'polynomial'"),
        (lambda: convert(draw("linear", 1), form("bspline", (0.0, 5000.0), 3, 20)), "23 parameters are wanted"),
        (lambda: fit([0.0, 1.0], [0.0, 1.0], "legendre", order=2), "3 parameters are wanted, but these samples or this stroke determine 2"),
        (lambda: fit([0.0, 1.0], [0.0, np.nan], "legendre", order=0), "finite values"),
        (lambda: fit([0.0, 1.0], [0.0], "legendre", order=0), r"shapes \(2,\) and \(1,\)"),
        (lambda: fit([], [], "legendre", order=0), "samples"),
    ],
)
def test_what_cannot_be_converted_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
