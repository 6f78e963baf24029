"""Batched trials give what a loop over trials gives: the same estimates for the same draws, the same statistics."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from abbe.models.paths import helix_points
from abbe.models.uncertainty.distributions import Distribution
from tests.experiments.mathematics import helix_trials as module
from tests.experiments.mathematics.helix_trials import HelixTask, fit_trials, helix_trials, linear_estimator, linear_trials

RADIUS, SIGMA = 150.0, 5e-4
POINTS = helix_points(np.zeros(3), RADIUS, turns=3, n=63, law="angle", axis=2)
TRUE = np.array([120e-6, -80e-6, 40e-6, 60e-6, -90e-6, 30e-6, 0.012, -0.02, 0.008, 1.2e-3])


ANGLE = np.linspace(0.0, 2.0 * np.pi, 63, endpoint=False)
CIRCLE = RADIUS * np.column_stack([np.cos(ANGLE), np.sin(ANGLE), 0.0 * ANGLE])


def problem(seed=0, n=80, p=12):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n, p)) * np.logspace(-3, 3, p), rng.uniform(0.5, 2.0, n), rng.normal(size=p)


def task(u_length_mm=None):
    return HelixTask(POINTS, RADIUS, SIGMA, u_length_mm)


def readings(t):
    return t.jacobian(TRUE[None, : len(t.names)])[0][0]


def test_linear_estimates_are_those_of_lstsq_for_the_same_draws():
    a, sigma, theta = problem()
    estimator = linear_estimator(a, sigma)
    y = a @ theta + sigma * np.random.default_rng(1).normal(size=(20, len(sigma)))
    loop = [np.linalg.lstsq(a / sigma[:, None], row / sigma, rcond=None)[0] for row in y]
    u = np.sqrt(np.diag(estimator.covariance))
    assert np.abs((estimator.solve(y) - loop) / u).max() < 1e-9


def test_linear_estimates_with_priors_are_those_of_lstsq_with_prior_rows():
    a, sigma, theta = problem()
    prior = np.abs(theta) + 0.1
    prior[3] = np.inf
    a[:, 5] = a[:, 4]  # told apart by the prior alone
    rows = np.diag(1.0 / prior)
    y = a @ theta + sigma * np.random.default_rng(1).normal(size=(5, len(sigma)))
    loop = [np.linalg.lstsq(np.r_[a / sigma[:, None], rows], np.r_[v / sigma, np.zeros(len(theta))], rcond=None)[0] for v in y]
    np.testing.assert_allclose(linear_estimator(a, sigma, prior).solve(y), loop, rtol=1e-8, atol=1e-9 * np.nanmin(prior))


def test_linear_statistics_are_those_of_theory_and_of_the_loop():
    a, sigma, theta = problem()
    estimator = linear_estimator(a, sigma)
    found = linear_trials(estimator, a @ theta, np.random.default_rng(5), 40_000)
    u = np.sqrt(np.diag(estimator.covariance))
    assert np.abs((found.mean - theta) / u).max() < 4.5 / np.sqrt(found.trials)
    assert np.abs(found.covariance / np.outer(u, u) - estimator.covariance / np.outer(u, u)).max() < 6.0 / np.sqrt(found.trials)


def test_chunks_do_not_change_linear_trials(monkeypatch):
    a, sigma, theta = problem()
    estimator = linear_estimator(a, sigma)
    whole = linear_trials(estimator, a @ theta, np.random.default_rng(5), 1000)
    monkeypatch.setattr(module, "CHUNK_VALUES", 777)
    parts = linear_trials(estimator, a @ theta, np.random.default_rng(5), 1000)
    u = np.sqrt(np.diag(estimator.covariance))
    assert np.abs((whole.mean - parts.mean) / u).max() < 1e-6
    assert whole.trials == parts.trials == 1000


def test_noise_of_another_shape_keeps_its_variance_in_linear_trials():
    a, sigma, theta = problem()
    estimator = linear_estimator(a, sigma)
    found = linear_trials(estimator, a @ theta, np.random.default_rng(5), 20_000, noise=Distribution("t", 1.0, 6.0))
    ratio = np.diag(found.covariance) / np.diag(estimator.covariance)
    np.testing.assert_allclose(ratio, 1.5, atol=0.07)


def test_linear_trials_refuse_what_has_no_solution():
    a, sigma, _ = problem()
    a[:, 5] = a[:, 4]
    with pytest.raises(ValueError, match="neither data nor prior"):
        linear_estimator(a, sigma)
    with pytest.raises(ValueError, match="do not fit or are not positive"):
        linear_estimator(a, np.zeros(len(sigma)))


def test_one_trial_that_is_no_number_is_named_and_spoils_no_other_silently():
    y = readings(task()) + np.random.default_rng(2).normal(0.0, SIGMA, (20, len(POINTS)))
    y[3, 5] = np.nan
    with pytest.raises(ValueError, match="trial 3"):
        fit_trials(task(), y)


def test_linear_trials_refuse_no_trials_and_numbers_that_are_none():
    a, sigma, theta = problem()
    estimator = linear_estimator(a, sigma)
    for readings_mm, trials in ((a @ theta, 0), (np.full(len(sigma), np.nan), 10)):
        with pytest.raises(ValueError, match="linear trials"):
            linear_trials(estimator, readings_mm, np.random.default_rng(0), trials)
    with pytest.raises(ValueError, match="linear trials: the design"):
        linear_estimator(np.where(a == a[0, 0], np.nan, a), sigma)


@pytest.mark.parametrize("u_length_mm", [None, 1e-3])
def test_helix_estimates_are_those_of_scipy_for_the_same_draws(u_length_mm):
    """Both minimise the same sum of squares: they differ by less than a millionth of the standard uncertainty."""
    t = task(u_length_mm)
    p = len(t.names)
    y = readings(t) + np.random.default_rng(2).normal(0.0, SIGMA, (6, len(POINTS)))
    field = np.zeros((len(POINTS), 3, 6))  # written anew here, from eq (4) of the paper
    x, yy, z = POINTS.T
    field[:, 0, 0], field[:, 1, 1], field[:, 2, 2] = x, yy, z
    field[:, 0, 3], field[:, 0, 4], field[:, 1, 5] = -yy, z, -z

    def misfit(scaled, row):
        theta = scaled * np.r_[np.full(6, 1e-5), np.full(4, 1e-3)][:p]
        tip = POINTS + field @ theta[:6] - (theta[6:9] if p == 10 else 0.0)
        left = (row - (np.linalg.norm(tip, axis=1) - RADIUS + (theta[9] if p == 10 else 0.0))) / SIGMA
        return np.r_[left, theta[9] / u_length_mm] if p == 10 else left

    unit = np.r_[np.full(6, 1e-5), np.full(4, 1e-3)][:p]
    options = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15, "jac": "3-point"}
    loop = np.array([least_squares(misfit, np.zeros(p), args=(row,), **options).x for row in y]) * unit
    fits = fit_trials(t, y)
    assert fits.converged.all()
    assert np.abs((fits.theta - loop) / posterior_u(t)).max() < 1e-4


def posterior_u(t):
    j = t.jacobian(TRUE[None, : len(t.names)])[1][0] / t.sigma_mm
    normal = j.T @ j
    if t.u_length_mm:
        normal[9, 9] += t.u_length_mm**-2
    return np.sqrt(np.diag(np.linalg.inv(normal)))


@pytest.mark.parametrize("u_length_mm", [None, 1e-3])
def test_helix_statistics_are_those_of_propagation(u_length_mm):
    """Six and ten unknowns; with ten, every trial has a calibration of the bar of its own."""
    t = task(u_length_mm)
    found = helix_trials(t, readings(t), np.random.default_rng(3), 20_000)
    u = posterior_u(t)
    assert found.failed == 0
    assert found.trials == 20_000
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)) / u, 1.0, atol=0.03)
    undisturbed = fit_trials(t, readings(t)[None]).theta[0]  # the calibration, not the truth, says how long the bar is
    assert np.abs((found.mean - undisturbed) / u).max() < 0.05


def test_helix_trials_far_from_the_mean_one_converge_the_slow_way(monkeypatch):
    """A cup 8 mm off in one trial of three: its own Jacobian is needed, and found."""
    t = task(1e-3)
    far = TRUE.copy()
    far[6:9] = [8.0, -5.0, 6.0]
    y = np.stack([readings(t), t.jacobian(far[None])[0][0], readings(t)])
    monkeypatch.setattr(module, "FAST_STEPS", 2)
    fits = fit_trials(t, y)
    assert fits.converged.all()
    np.testing.assert_allclose(fits.theta[1, 6:9], far[6:9], atol=1e-3)
    monkeypatch.setattr(module, "SLOW_STEPS", 1)
    assert not fit_trials(t, y).converged[1]


def test_the_jacobian_of_a_helix_is_its_derivative():
    t = task(1e-3)
    _, j = t.jacobian(TRUE[None])
    step = np.r_[np.full(6, 1e-6), np.full(4, 1e-4)]
    for k in range(10):
        up, down = (t.jacobian((TRUE + s * step * (np.arange(10) == k))[None])[0][0] for s in (1, -1))
        np.testing.assert_allclose(j[0, :, k], (up - down) / (2 * step[k]), atol=1e-5 * max(1.0, np.abs(j[0, :, k]).max()))


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: HelixTask(POINTS[:5], RADIUS, SIGMA),
        lambda: HelixTask(POINTS, RADIUS, 0.0),
        lambda: HelixTask(POINTS, RADIUS, SIGMA, 0.0),
        lambda: fit_trials(task(), np.zeros((3, 5))),
        lambda: fit_trials(task(), np.zeros((3, 63)), np.zeros(3)),
        lambda: helix_trials(task(), np.zeros(63), np.random.default_rng(0), 0),
        lambda: helix_trials(task(), np.full(63, np.nan), np.random.default_rng(0), 100),
        lambda: fit_trials(task(), np.zeros((0, 63))),
        lambda: HelixTask(np.full((63, 3), np.nan), RADIUS, SIGMA),
        lambda: HelixTask(CIRCLE, RADIUS, SIGMA),
        lambda: HelixTask(CIRCLE, RADIUS, SIGMA, 1e-3),
    ],
)
def test_helix_trials_refuse_what_cannot_be_solved(wrong):
    with pytest.raises(ValueError, match="helix trials"):
        wrong()
