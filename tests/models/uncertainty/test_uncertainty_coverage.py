"""Coverage factors and intervals against the published examples of the GUM and its Supplement 1."""

import numpy as np
import pytest

from abbe.models.uncertainty.coverage import coverage_factor, effective_dof, shortest_interval, symmetric_interval, vector_factor
from abbe.models.uncertainty.distributions import Distribution, Moments
from abbe.models.uncertainty.monte_carlo import VALIDATION_SHARE, adaptive, batch_size, numerical_tolerance, validate


def test_effective_degrees_of_freedom_of_the_guide_s_end_gauge():
    """GUM H.1.6: 25, 9.7, 2.9 and 16.6 nm with 18, 25.6, 50 and 2 degrees of freedom have 16 together; k for 99 % is 2.92."""
    dof = effective_dof(np.array([25.0, 9.7, 2.9, 16.6])[:, None] ** 2, np.array([18.0, 25.6, 50.0, 2.0]))
    assert int(dof[0]) == 16
    assert coverage_factor(np.floor(dof), 0.99)[0] == pytest.approx(2.92, abs=0.005)


def test_coverage_factors_of_tables():
    np.testing.assert_allclose(coverage_factor(np.array([1.0, 10.0, np.inf])), [12.706, 2.228, 1.960], atol=5e-4)
    assert vector_factor(3) == pytest.approx(2.795, abs=1e-3)
    assert vector_factor(1) == pytest.approx(1.960, abs=1e-3)
    assert effective_dof(np.ones((2, 3)), np.array([np.inf, np.inf])).tolist() == [np.inf] * 3


@pytest.mark.parametrize("probability", [0.0, 1.0, 95.0])
def test_a_probability_outside_0_to_1_is_refused(probability):
    with pytest.raises(ValueError, match="probability"):
        coverage_factor(np.array([5.0]), probability)


def test_shortest_and_symmetric_interval_of_a_skewed_distribution():
    """Exponential: the shortest 95 % begins at 0 and ends at -ln 0.05; the symmetric one cuts 2.5 % on each side."""
    x = np.random.default_rng(4).exponential(size=(400_000, 1))
    short, even = shortest_interval(x), symmetric_interval(x)
    np.testing.assert_allclose([short.low[0], short.high[0]], [0.0, -np.log(0.05)], atol=0.03)
    np.testing.assert_allclose([even.low[0], even.high[0]], [-np.log(0.975), -np.log(0.025)], atol=0.03)
    assert short.width[0] < even.width[0]


def test_too_few_trials_for_an_interval_are_refused():
    with pytest.raises(ValueError, match="too few"):
        shortest_interval(np.zeros((5, 1)))


def additive(*inputs: Distribution):
    """The additive model of GUM-S1 9.2: the sum of four inputs."""

    def draw(rng, trials):
        x = np.zeros((len(inputs), trials, 1))
        for d, out in zip(inputs, x, strict=True):
            d.fill(rng, out)
        return x.sum(axis=0)

    return draw


@pytest.mark.parametrize(
    ("inputs", "u", "end", "valid"),
    [
        ([Distribution("normal")] * 4, 2.00, 3.92, True),  # 9.2.2
        ([Distribution("rectangular")] * 4, 2.00, 3.88, True),  # 9.2.3: 3.92 of the GUM is off by 0.04, 0.05 is allowed
        ([Distribution("rectangular")] * 3 + [Distribution("rectangular", 10.0)], 10.15, 17.0, False),  # 9.2.4: the GUM says 19.9
    ],
)
def test_additive_models_of_supplement_1(inputs, u, end, valid):
    found = adaptive(additive(*inputs), np.random.default_rng(9), share=VALIDATION_SHARE, largest=10_000_000)
    assert found.settled.all()
    assert found.u[0] == pytest.approx(u, rel=0.005)
    for interval in (found.symmetric, found.shortest):
        np.testing.assert_allclose([-interval.low[0], interval.high[0]], end, atol=0.01 * end)
    gum = 1.96 * np.sqrt(sum(d.sd**2 for d in inputs))
    assert validate(np.zeros(1), np.array([gum]), found, digits=2).valid[0] == valid


def test_monte_carlo_is_decided_by_the_seed_and_says_what_did_not_settle():
    draw = additive(*[Distribution("normal")] * 4)
    one, two = (adaptive(draw, np.random.default_rng(3), largest=40_000) for _ in range(2))
    assert one.trials == two.trials == 40_000
    assert one.u[0] == two.u[0]
    assert one.shortest.low[0] == two.shortest.low[0]
    assert not one.settled.any()
    np.testing.assert_allclose(np.sqrt(one.covariance[0, 0]), one.u)


def test_numerical_tolerance_is_half_a_unit_of_the_last_digit():
    np.testing.assert_allclose(numerical_tolerance(np.array([0.00035, 2.0, 0.0]), 2), [5e-6, 0.05, np.inf])
    np.testing.assert_allclose(numerical_tolerance(np.array([0.00035]), 1), [5e-5])


def test_a_batch_is_as_large_as_the_supplement_asks_and_ten_of_them_are_run():
    """GUM-S1 7.9.4: M = max(J, 10^4), J of 100 / (1 - p) or more."""
    assert [batch_size(p) for p in (0.5, 0.95, 0.99, 0.999)] == [10_000, 10_000, 10_000, 100_000]
    seen = []

    def constant(rng, trials):
        seen.append(trials)
        return np.zeros((trials, 1)) + rng.normal(0.0, 1e-9, (trials, 1)) ** 3

    found = adaptive(constant, np.random.default_rng(0), digits=1)
    assert seen[:10] == [10_000] * 10  # the spread of two batches may be small by chance
    assert found.trials >= 100_000
    adaptive(constant, np.random.default_rng(0), digits=1, probability=0.999)
    assert seen[-1] == 100_000


def test_what_is_called_settled_is_known_to_the_tolerance():
    """Ends of 1.96 sd for 40 seeds; twice the standard deviation of the mean, so 5 % of each of six figures may miss it, not by much."""
    off = []
    for seed in range(40):
        found = adaptive(lambda rng, n: 2.0 * rng.standard_normal((n, 1)), np.random.default_rng(seed), digits=1, share=0.1)
        assert found.settled.all()
        off.append(abs(found.symmetric.high[0] - 1.96 * 2.0) / found.tolerance[0])
    assert np.mean(np.array(off) < 1.0) > 0.9
    assert max(off) < 2.0


def test_trials_that_are_not_known_well_enough_do_not_judge_the_law_of_propagation():
    """GUM-S1 8.2: a fifth of the tolerance."""

    def normal(rng, trials):
        return 2.0 * rng.standard_normal((trials, 1))

    coarse = adaptive(normal, np.random.default_rng(1), digits=1)
    fine = adaptive(normal, np.random.default_rng(1), digits=1, share=VALIDATION_SHARE)
    short = adaptive(normal, np.random.default_rng(1), digits=2, share=VALIDATION_SHARE, largest=20_000)
    for found, digits in ((coarse, 2), (fine, 2), (short, 1), (short, 2)):
        with pytest.raises(ValueError, match="too few to validate"):
            validate(np.zeros(1), np.full(1, 3.92), found, digits=digits)
    assert validate(np.zeros(1), np.full(1, 3.92), fine).valid.all()


@pytest.mark.parametrize(
    "arguments", [{"digits": 3}, {"share": 0.0}, {"share": 2.0}, {"largest": 500}, {"probability": 1.0}, {"probability": float("nan")}]
)
def test_monte_carlo_refuses_what_it_cannot_do(arguments):
    with pytest.raises(ValueError, match="Monte Carlo"):
        adaptive(additive(Distribution()), np.random.default_rng(0), **arguments)


@pytest.mark.parametrize("d", [Distribution("normal", 3.0), Distribution("rectangular", 3.0), Distribution("t", 3.0, 9.0)])
@pytest.mark.parametrize("precision", [np.float64, np.float32])
def test_drawn_inputs_have_the_stated_standard_deviation(d, precision):
    out = np.empty(400_000, dtype=precision)
    d.fill(np.random.default_rng(2), out)
    assert out.dtype == precision
    assert out.std() == pytest.approx(d.sd, rel=0.01)
    assert abs(out.mean()) < 0.03
    if d.shape == "rectangular":
        assert np.abs(out).max() <= 3.0 * np.sqrt(3.0) + 1e-5
    if d.shape == "t":
        assert d.sd == pytest.approx(3.0 * np.sqrt(9.0 / 7.0))


@pytest.mark.parametrize(("shape", "u", "dof"), [("triangle", 1.0, 5.0), ("normal", -1.0, 5.0), ("normal", np.inf, 5.0), ("t", 1.0, 2.0)])
def test_a_distribution_without_a_variance_is_refused(shape, u, dof):
    with pytest.raises(ValueError, match="distribution"):
        Distribution(shape, u, dof)


def test_moments_of_chunks_are_those_of_the_whole_and_keep_their_digits():
    x = 1e6 + np.random.default_rng(1).normal(size=(5000, 3)) @ np.array([[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1e-3]])
    m = Moments(x[0].copy())
    for part in np.array_split(x, 7):
        m.add(part)
    np.testing.assert_allclose(m.mean, x.mean(axis=0), rtol=1e-14)
    np.testing.assert_allclose(m.covariance, np.cov(x.T), rtol=1e-6, atol=1e-9)
    with pytest.raises(ValueError, match="two results"):
        _ = Moments(np.zeros(1)).covariance
