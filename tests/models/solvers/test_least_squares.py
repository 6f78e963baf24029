"""The solver against numpy's and against the propagation law (GUM 5.2), and what it must refuse."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from abbe.models.solvers.least_squares import solve_map


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.integers(0, 10_000), st.integers(1, 6), st.integers(8, 30))
def test_without_priors_it_is_weighted_least_squares(seed, p, n):
    rng = np.random.default_rng(seed)
    a, y, sigma = rng.normal(size=(n, p)) * 10.0 ** rng.uniform(-6, 3, p), rng.normal(size=n), rng.uniform(0.5, 2.0, n)
    names = tuple(f"p{k}" for k in range(p))
    e = solve_map(names, a, y, sigma, np.full(p, np.inf))
    want = np.linalg.lstsq(a / sigma[:, None], y / sigma, rcond=None)[0]
    gain = np.linalg.pinv(a / sigma[:, None]) / sigma  # theta = gain y, so its covariance is gain diag(sigma^2) gain'
    assert e.theta == pytest.approx(want, rel=1e-7)
    assert np.sqrt(np.diag(e.covariance)) == pytest.approx(
        np.sqrt(np.diag(gain @ np.diag(sigma**2) @ gain.T) * e.variance_factor), rel=1e-7
    )
    assert e.dof == n - p
    assert e.data_share.tolist() == [1.0] * p


def test_scatter_of_repeated_solutions_is_the_stated_covariance():
    rng = np.random.default_rng(7)
    a, sigma, prior = rng.normal(size=(40, 3)), np.full(40, 0.3), np.array([1.0, 0.05, np.inf])
    found, stated = [], []
    for _ in range(600):
        theta = np.array([rng.normal(0, 1.0), rng.normal(0, 0.05), 2.0])
        e = solve_map(("a", "b", "c"), a, a @ theta + rng.normal(0, sigma), sigma, prior)
        found.append(e.theta - theta)
        stated.append(np.diag(e.covariance) / e.variance_factor)
    assert np.std(found, axis=0) == pytest.approx(np.sqrt(np.mean(stated, axis=0)), rel=0.1)


def test_a_combination_that_nothing_knows_is_named():
    a = np.ones((9, 2))
    with pytest.raises(ValueError, match=r"neither observations nor a prior determine [ab]"):
        solve_map(("a", "b"), a, np.zeros(9), np.ones(9), np.full(2, np.inf))
    assert solve_map(("a", "b"), a, np.ones(9), np.ones(9), np.array([1.0, np.inf])).value("a") == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("y", "sigma"), [(np.zeros(8), np.ones(8)), (np.full(9, np.nan), np.ones(9)), (np.zeros(9), np.zeros(9))])
def test_what_is_no_problem_is_refused(y, sigma):
    with pytest.raises(ValueError, match="least squares"):
        solve_map(("a", "b"), np.ones((9, 2)), y, sigma, np.ones(2))
