"""Random errors by quadrature and by covariance: against the sums of math.md 2.2, against draws, and at the two ends of a length."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from abbe.models.geometry.chain import all_chains, deviation_mm
from abbe.models.machine import Machine
from abbe.models.notation.pahk import TYPES, motions_from_pahk, pahk_machine
from abbe.models.papers.pahk.diagonals import length_random_error_mm, shared_variables
from abbe.models.papers.pahk.random_errors import (
    PARAMETERS,
    REPEATABILITY_COVERAGE,
    RandomErrors,
    iso_parameter_jacobian,
    parameter_jacobian,
    printed_eq5_mm,
    propagate,
    quadrature_mm,
)


def draw(rng) -> RandomErrors:
    return RandomErrors(rng.uniform(0, 0.01, (3, 3)), rng.uniform(0, 3e-5, (3, 3)), rng.uniform(0, 5e-5, 3), 1.0)


def squares(random):
    """R^2 by name: d["xX"] for dx(X), e["xX"] for Ex(X)."""
    d = {i + j: random.d_mm[a, b] ** 2 for a, j in enumerate("XYZ") for b, i in enumerate("xyz")}
    e = {i + j: random.e_rad[a, b] ** 2 for a, j in enumerate("XYZ") for b, i in enumerate("xyz")}
    return d, e, random.squareness_rad**2


def test_mb1_and_mh2_are_the_sums_of_the_text():
    rng = np.random.default_rng(3)
    random, (x, y, z), (xp, yp, zp) = draw(rng), rng.uniform(0, 500, 3), rng.normal(0, 60, 3)
    d, e, (a, b1, b2) = squares(random)
    sx, sy, sz = (sum(d[i + j] for j in "XYZ") for i in "xyz")
    mb1 = [
        sx + z**2 * b1 + (z + zp) ** 2 * (e["yX"] + e["yY"]) + zp**2 * e["yZ"] + yp**2 * (e["zX"] + e["zY"] + e["zZ"]),
        sy
        + x**2 * a
        + (x + xp) ** 2 * e["zY"]
        + xp**2 * (e["zX"] + e["zZ"])
        + z**2 * b2
        + (z + zp) ** 2 * (e["xX"] + e["xY"])
        + zp**2 * e["xZ"],
        sz + (x + xp) ** 2 * e["yY"] + xp**2 * (e["yX"] + e["yZ"]) + yp**2 * (e["xX"] + e["xY"] + e["xZ"]),
    ]
    ez, ey = e["zX"] + e["zY"] + e["zZ"], e["yX"] + e["yY"] + e["yZ"]
    mh2 = [
        sx + (y + yp) ** 2 * (e["zX"] + e["zZ"]) + yp**2 * e["zY"] + z**2 * b1 + (z + zp) ** 2 * e["yX"] + zp**2 * (e["yY"] + e["yZ"]),
        sy + x**2 * a + z**2 * b2 + (z + zp) ** 2 * e["xX"] + zp**2 * (e["xY"] + e["xZ"]) + xp**2 * ez,
        sz + (y + yp) ** 2 * (e["xX"] + e["xZ"]) + yp**2 * e["xY"] + xp**2 * ey,
    ]
    for name, expected in (("MB1", mb1), ("MH2", mh2)):
        found = quadrature_mm(parameter_jacobian(TYPES[name], np.array([[x, y, z]]), np.array([xp, yp, zp])), random)
        assert found[0] ** 2 == pytest.approx(expected, rel=1e-13)


def test_equation_5_as_printed_holds_without_probe_offset_only():
    rng = np.random.default_rng(4)
    random, axes = draw(rng), rng.uniform(50, 500, (5, 3))
    right = quadrature_mm(parameter_jacobian(TYPES["MB1"], axes), random)
    assert printed_eq5_mm(axes, np.zeros(3), random) == pytest.approx(right, rel=1e-13)
    far, near = np.array([60.0, 0.0, 60.0]), np.array([-60.0, 0.0, -60.0])
    for probe, sign in ((far, -1), (near, 1)):  # too small where the offset lengthens the lever, too large where it shortens it
        right = quadrature_mm(parameter_jacobian(TYPES["MB1"], axes, probe), random)
        assert (sign * (printed_eq5_mm(axes, probe, random) - right)[:, 0] > 0).all()


@pytest.mark.parametrize("name", TYPES)
def test_quadrature_and_covariance_agree_with_draws(name):
    rng = np.random.default_rng(5)
    kind, random, probe, n = TYPES[name], draw(rng), np.array([20.0, -30.0, 45.0]), 40_000
    axes = np.array([[310.0, 220.0, 140.0]])
    v = rng.normal(size=(n, 21)) * random.vector
    motions = np.concatenate([_one(kind, axes, row) for row in (np.zeros(21), *np.eye(21))])
    machine = pahk_machine(kind, np.array([[0.0, 900.0]] * 3), probe)
    unit = deviation_mm(machine, np.repeat(axes, 22, axis=0), motions)  # independent of the Jacobian: rule G on unit errors
    off = v @ (unit[1:] - unit[0])
    jacobian = parameter_jacobian(kind, axes, probe)
    sigma = quadrature_mm(jacobian, random)[0]
    assert off.std(axis=0) == pytest.approx(sigma, rel=0.02)
    covariance = propagate(jacobian, np.diag(random.vector**2))[0]
    assert np.sqrt(np.diag(covariance)) == pytest.approx(sigma, rel=1e-12)
    assert np.cov(off.T) == pytest.approx(covariance, abs=0.03 * sigma.max() ** 2)


def _one(kind, axes, row):
    return motions_from_pahk(kind, axes, row[None, :9].reshape(1, 3, 3), row[None, 9:18].reshape(1, 3, 3), row[18:])


def test_wholly_correlated_parameters_add_like_numbers():
    rng = np.random.default_rng(6)
    random, axes = draw(rng), rng.uniform(0, 400, (4, 3))
    jacobian = parameter_jacobian(TYPES["CY"], axes)
    found = propagate(jacobian, np.outer(random.vector, random.vector))
    along = jacobian @ random.vector
    assert found == pytest.approx(along[:, :, None] * along[:, None, :], rel=1e-9, abs=1e-18)
    for bad in (np.eye(20), np.triu(np.ones((21, 21))), np.full((21, 21), np.nan), -np.eye(21)):
        with pytest.raises(ValueError, match="covariance"):
            propagate(jacobian, bad)


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(all_chains()), st.integers(0, 2**31))
def test_quadrature_is_at_least_each_part_and_never_more_than_their_sum(chain, seed):
    rng = np.random.default_rng(seed)
    random, axes = draw(rng), rng.uniform(-300, 300, (3, 3))
    machine = Machine(chain, np.array([[-300.0, 300.0]] * 3), rng.normal(0, 50, (3, 3)), rng.normal(0, 50, 3))
    jacobian = iso_parameter_jacobian(machine, axes)
    parts = np.abs(jacobian * random.vector)
    total = quadrature_mm(jacobian, random)
    assert (total >= parts.max(axis=2) * (1 - 1e-12)).all()
    assert (total <= parts.sum(axis=2) * (1 + 1e-12)).all()


@pytest.mark.parametrize("name", TYPES)
def test_iso_and_pahk_names_give_the_same_random_error_of_the_deviation(name):
    rng = np.random.default_rng(8)
    kind, random, axes = TYPES[name], draw(rng), rng.uniform(0, 500, (4, 3))
    functions = RandomErrors(random.d_mm, random.e_rad, np.zeros(3), 1.0)  # the datum of squareness differs: leave it out
    machine = pahk_machine(kind, np.array([[0.0, 1.0]] * 3))
    assert quadrature_mm(iso_parameter_jacobian(machine, axes), functions) == pytest.approx(
        quadrature_mm(parameter_jacobian(kind, axes), functions), rel=1e-13
    )


def test_coverage_is_said_and_kept():
    random = RandomErrors(np.full((3, 3), 0.002), np.zeros((3, 3)), np.zeros(3), REPEATABILITY_COVERAGE)
    sigma = random.in_coverage(1.0)
    assert sigma.coverage == 1.0
    assert sigma.d_mm == pytest.approx(np.full((3, 3), 0.001))
    jacobian = parameter_jacobian(TYPES["MB1"], np.zeros((1, 3)))
    assert quadrature_mm(jacobian, random)[0] == pytest.approx(2 * quadrature_mm(jacobian, sigma)[0])
    for d, k in ((np.full((3, 3), -1.0), 1.0), (np.full((3, 3), np.nan), 1.0), (np.zeros(3), 1.0), (np.zeros((3, 3)), 0.0)):
        with pytest.raises(ValueError, match="random errors"):
            RandomErrors(d, np.zeros((3, 3)), np.zeros(3), k)


@pytest.mark.parametrize("name", ["MB1", "FB1", "CX"])
@pytest.mark.parametrize("still", [(), (1,), (0, 2)])
def test_a_length_has_two_variables_per_moving_function_and_one_per_shared_one(name, still):
    rng = np.random.default_rng(9)
    kind, n, probe = TYPES[name], 40_000, np.array([10.0, 20.0, -30.0])
    ends = np.array([[50.0, 40.0, 30.0], [800.0, 500.0, 350.0]])
    ends[1, list(still)] = ends[0, list(still)]
    shared = shared_variables(ends)
    assert [PARAMETERS[k] for k in np.flatnonzero(shared)][-3:] == ["alpha", "beta1", "beta2"]
    start, end = draw(rng), draw(rng)
    d, e = start.d_mm.copy(), start.e_rad.copy()
    move = [j for j in range(3) if j not in still]
    d[move], e[move] = end.d_mm[move], end.e_rad[move]
    end = RandomErrors(d, e, start.squareness_rad, 1.0)
    first = rng.normal(size=(n, 21)) * start.vector
    last = np.where(shared, first, rng.normal(size=(n, 21)) * end.vector)
    jacobian = parameter_jacobian(kind, ends, probe)
    way = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    length = (last @ jacobian[1].T - first @ jacobian[0].T) @ way
    assert length_random_error_mm(kind, ends, (start, end), probe) == pytest.approx(length.std(), rel=0.02)
    with pytest.raises(ValueError, match="same coverage"):
        length_random_error_mm(kind, ends, (start, end.in_coverage(2.0)), probe)
    with pytest.raises(ValueError, match="different ends"):
        length_random_error_mm(kind, ends[[0, 0]], (start, end), probe)


def test_only_squareness_is_random_then_the_diagonal_takes_its_whole_difference():
    zero, angle = np.zeros((3, 3)), 1e-5
    one = RandomErrors(zero, zero, np.array([angle, 0.0, 0.0]), 1.0)
    ends = np.array([[100.0, 0.0, 0.0], [900.0, 575.0, 400.0]])
    way = ends[1] - ends[0]
    found = length_random_error_mm(TYPES["MB1"], ends, (one, one))
    assert found == pytest.approx(angle * 800.0 * 575.0 / np.linalg.norm(way))  # 800 of travel, not the root of 100^2 + 900^2
