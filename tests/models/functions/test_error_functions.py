"""Error functions of one axis: value and slope of every kind, what holds outside, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy import interpolate

from abbe.models.functions.bspline import BSpline, clamped_knots
from abbe.models.functions.legendre import Legendre
from abbe.models.functions.polynomial import Polynomial
from abbe.models.functions.table import Table

KINDS = ("polynomial", "legendre", "bspline", "linear", "cubic")


def random_function(kind: str, seed: int, lo: float = -120.0, length: float = 700.0):
    rng = np.random.default_rng(seed)
    if kind == "polynomial":
        return Polynomial(rng.normal(size=5) / length ** np.arange(5), lo + 0.3 * length)
    if kind == "legendre":
        return Legendre(rng.normal(size=6), (lo, lo + length))
    if kind == "bspline":
        inner = lo + length * (np.arange(1, 7) + rng.uniform(-0.4, 0.4, 6)) / 7.0
        knots = np.concatenate([np.full(4, lo), inner, np.full(4, lo + length)])
        return BSpline(knots, rng.normal(size=10), 3)
    inner = (np.arange(1, 8) + rng.uniform(-0.4, 0.4, 7)) / 8.0  # not close together: a cubic would swing far beyond its values there
    position = lo + length * np.concatenate([[0.0], inner, [1.0]])
    return Table(position, rng.normal(size=9), kind)


def reference(f, x: float) -> float:
    """The value from the definition, by other means than numpy's and scipy's evaluation."""
    if isinstance(f, Polynomial):
        return sum(c * (x - f.origin_mm) ** k for k, c in enumerate(f.coefficients))
    x = min(max(x, f.domain_mm[0]), f.domain_mm[1])
    if isinstance(f, Legendre):
        u = 2.0 * (x - f.stroke_mm[0]) / (f.stroke_mm[1] - f.stroke_mm[0]) - 1.0
        p = [1.0, u]
        for k in range(1, len(f.coefficients)):
            p.append(((2 * k + 1) * u * p[k] - k * p[k - 1]) / (k + 1))
        return sum(c * p[k] for k, c in enumerate(f.coefficients))
    if isinstance(f, BSpline):
        return sum(c * hump(f.knots_mm, i, f.degree, x) for i, c in enumerate(f.coefficients))
    i = min(max(int(np.sum(f.position_mm <= x)) - 1, 0), f.value.size - 2)
    share = (x - f.position_mm[i]) / (f.position_mm[i + 1] - f.position_mm[i])
    return (1.0 - share) * f.value[i] + share * f.value[i + 1]


def hump(t, i: int, k: int, x: float) -> float:
    """Cox - de Boor."""
    if k == 0:
        last = x == t[-1] and t[i] < t[i + 1] == t[-1]
        return float(t[i] <= x < t[i + 1] or last)
    left = (x - t[i]) / (t[i + k] - t[i]) * hump(t, i, k - 1, x) if t[i + k] > t[i] else 0.0
    right = (t[i + k + 1] - x) / (t[i + k + 1] - t[i + 1]) * hump(t, i + 1, k - 1, x) if t[i + k + 1] > t[i + 1] else 0.0
    return left + right


@pytest.mark.parametrize("kind", ["polynomial", "legendre", "bspline", "linear"])
@given(seed=st.integers(0, 10_000), x=st.floats(-300.0, 900.0))
@settings(max_examples=60, deadline=None)
def test_value_is_that_of_the_definition(kind, seed, x):
    f = random_function(kind, seed)
    assert_allclose(float(f(x)), reference(f, x), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("kind", KINDS)
@given(seed=st.integers(0, 10_000), share=st.floats(0.0, 1.0))
@settings(max_examples=60, deadline=None)
def test_slope_is_that_of_central_differences(kind, seed, share):
    f = random_function(kind, seed)
    lo, hi = f.domain_mm if np.isfinite(f.domain_mm[0]) else (-120.0, 580.0)
    x, h = lo + share * (hi - lo), 1e-3
    edges = np.asarray(f.breaks_mm)
    if edges.size and np.abs(edges - x).min() <= 2.0 * h:
        x = float(edges[np.abs(edges - x).argmin()]) + 3.0 * h  # two-sided differences do not hold across a kink
        if x > hi:
            x = hi - 3.0 * h
    assert_allclose(float(f.derivative(x)), float(f(x + h) - f(x - h)) / (2.0 * h), rtol=1e-5, atol=1e-8)


def test_cubic_table_goes_through_its_values_and_bends_without_jump():
    f = random_function("cubic", 3)
    assert_allclose(f(f.position_mm), f.value, rtol=1e-13)
    inner, h = f.position_mm[1:-1], 1e-4
    curve = [(f.derivative(inner + s * h) - f.derivative(inner + s * 2 * h)) / (-s * h) for s in (-1.0, 1.0)]
    assert_allclose(curve[0], curve[1], atol=2e-4 * np.abs(curve[0]).max() + 1e-7)
    cubic = np.polynomial.Polynomial([1.0, -2e-2, 3e-5, 4e-8])
    assert_allclose(Table(f.position_mm, cubic(f.position_mm), "cubic")(np.linspace(-120, 580, 99)), cubic(np.linspace(-120, 580, 99)))


@given(st.integers(1, 3), st.lists(st.integers(0, 4), min_size=4, max_size=9))
@settings(max_examples=200, deadline=None)
def test_knots_are_refused_exactly_where_scipy_has_no_function_or_no_slope(degree, knots):
    knots, m = np.sort(np.array(knots, dtype=float)), len(knots) - degree - 1
    try:
        interpolate.BSpline(knots, np.arange(1.0, m + 1.0), degree).derivative()
        wanted = m > degree
    except ValueError:
        wanted = False
    try:
        BSpline(knots, np.arange(1.0, m + 1.0), degree).derivative(knots)
        found = True
    except ValueError:
        found = False
    assert found == wanted


@pytest.mark.parametrize("kind", KINDS)
def test_no_positions_give_no_rows(kind):
    f = random_function(kind, 1)
    assert f.basis([]).shape == (0, f.parameters.size)
    assert f([]).shape == f.derivative([]).shape == (0,)


@pytest.mark.parametrize(("points", "degree"), [(2, 1), (3, 2)])
def test_a_short_cubic_table_is_a_line_or_a_parabola(points, degree):
    x = np.array([0.0, 3.0, 10.0])[:points]
    p = np.polynomial.Polynomial([1.0, 2.0, 3.0][: degree + 1])
    assert_allclose(Table(x, p(x), "cubic")(1.7), p(1.7), rtol=1e-13)


@pytest.mark.parametrize("kind", KINDS[1:])
def test_end_value_is_held_outside_and_slope_is_zero_there(kind):
    f = random_function(kind, 8)
    lo, hi = f.domain_mm
    assert_allclose(f([lo - 50.0, hi + 50.0]), f([lo, hi]), rtol=0, atol=0)
    assert (f.derivative([lo - 1e-9, lo - 50.0, hi + 50.0]) == 0.0).all()
    assert (f.derivative([lo, hi]) != 0.0).all()


def test_a_polynomial_goes_on():
    f = Polynomial([1.0, 2.0, 3.0], 10.0)
    assert float(f(1010.0)) == 1.0 + 2.0 * 1000.0 + 3.0 * 1e6
    assert f.domain_mm == (-np.inf, np.inf)
    assert float(Polynomial([4.0]).derivative(3.0)) == 0.0


def test_slope_of_a_linear_table_at_its_positions_is_that_to_the_right():
    f = Table([0.0, 1.0, 3.0], [0.0, 5.0, 4.0])
    assert f.derivative([0.0, 0.5, 1.0, 2.0, 3.0]).tolist() == [5.0, 5.0, -0.5, -0.5, -0.5]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shape", [(), (1,), (7,), (2, 3), (0,)])
def test_any_shape_of_positions(kind, shape):
    f = random_function(kind, 5)
    x = np.full(shape, 33.0)
    assert f(x).shape == f.derivative(x).shape == shape
    assert f(x).dtype == f.derivative(x).dtype == np.float64


@pytest.mark.parametrize("kind", KINDS)
def test_value_is_basis_times_parameters(kind):
    f = random_function(kind, 6)
    x = np.linspace(-200.0, 700.0, 41)
    assert_allclose(f.basis(x) @ f.parameters, f(x), rtol=1e-11, atol=1e-12)
    doubled = f.with_parameters(2.0 * f.parameters)
    assert type(doubled) is type(f)
    assert_allclose(doubled(x), 2.0 * f(x), rtol=1e-14, atol=1e-14)
    with pytest.raises(ValueError, match=r"expected .* numbers"):
        f.with_parameters(np.zeros(f.parameters.size + 1))


@pytest.mark.parametrize("kind", KINDS)
@given(seed=st.integers(0, 1000), offset=st.floats(-5, 5), slope=st.floats(-0.01, 0.01))
@settings(max_examples=25, deadline=None)
def test_every_kind_holds_a_straight_line_exactly(kind, seed, offset, slope):
    f = random_function(kind, seed)
    lo, hi = f.domain_mm if np.isfinite(f.domain_mm[0]) else (-120.0, 580.0)
    x = np.linspace(lo, hi, 57)
    assert_allclose(f.plus_line(offset, slope)(x) - f(x), offset + slope * x, rtol=0, atol=1e-12)
    assert type(f.plus_line(offset, slope)) is type(f)


@pytest.mark.parametrize("constant", [Polynomial([2.0], 5.0), Legendre([2.0], (0.0, 10.0))])
def test_a_constant_can_take_a_slope(constant):
    assert_allclose(constant.plus_line(1.0, 0.5)([0.0, 10.0]), [3.0, 8.0])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("bad", [np.nan, np.inf, [0.0, np.nan]])
def test_positions_that_are_no_numbers_are_refused(kind, bad):
    f = random_function(kind, 1)
    for call in (f, f.derivative):
        with pytest.raises(ValueError, match="axis position: expected finite numbers"):
            call(bad)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Polynomial([]), "coefficients: expected 1 or more finite numbers"),
        (lambda: Polynomial([1.0, np.nan]), "coefficients: expected 1 or more finite numbers"),
        (lambda: Polynomial([1.0], np.nan), "axis position"),
        (lambda: Polynomial([[1.0]]), r"got shape \(1, 1\)"),
        (lambda: Legendre([1.0], (5.0, 5.0)), r"stroke_mm: expected \[smaller, larger\]"),
        (lambda: Legendre([1.0], (5.0, np.inf)), r"stroke_mm: expected \[smaller, larger\]"),
        (lambda: BSpline([0, 0, 1, 1], [1.0, 2.0, 3.0], 1), "need 5 knots, got 4"),
        (lambda: BSpline([0, 1, 0, 1, 1], [1.0, 2.0, 3.0], 1), "never decrease"),
        (lambda: BSpline([0, 0, 0, 0, 1], [1.0, 2.0, 3.0], 1), "more than 2 times"),
        (
            lambda: BSpline([0, 0, 300, 300, 600, 600], [1.0, 2.0, 3.0, 4.0], 1),
            "knot 300 occurs more than 1 times",
        ),
        (lambda: BSpline([0, 1, 1, 1, 2, 3], [1.0, 2.0, 3.0], 2), "knot 1 occurs more than 2 times"),
        (lambda: BSpline([0, 0, 1, 1, 2, 2], [1.0, 2.0, 3.0], 2), "knots_mm must rise from knot 3 to knot 4"),
        (lambda: Table([0.0, 1e-5, 2.0, 3.0], [1e308, -1e308, 1e308, -1e308], "cubic"), "too large or too steep for a cubic spline"),
        (lambda: BSpline([0, 1, 2], [1.0, 2.0], 0), "degree 0"),
        (lambda: clamped_knots((0.0, 1.0), 0), "0 pieces"),
        (lambda: Table([0.0], [1.0]), "position_mm: expected 2 or more"),
        (lambda: Table([0.0, 1.0], [1.0, 2.0, 3.0]), "one value per position, got 3 values and 2 positions"),
        (lambda: Table([0.0, 1.0, 1.0], [1.0, 2.0, 3.0]), r"position_mm\[3\] = 1: expected positions that rise"),
        (lambda: Table([0.0, 1.0], [1.0, 2.0], "quintic"), "interpolation 'quintic'"),
    ],
)
def test_what_is_no_function_is_refused(make, message):
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_functions_cannot_be_changed_from_outside():
    given_values = np.array([1.0, 2.0])
    f = Table([0.0, 1.0], given_values)
    given_values[0] = 7.0
    assert float(f(0.0)) == 1.0
    with pytest.raises(ValueError, match="read-only"):
        f.value[0] = 3.0
