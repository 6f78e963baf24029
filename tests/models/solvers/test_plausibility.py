"""Evidence against the normal density itself, and that no run is suspected for being noisy, clumsily set up or hit by outliers."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from abbe.models.solvers.plausibility import Design, Part, conditional, scatter, suspects, together
from tests.models.solvers.truth import MACHINE, Truth

CONSTANT = 0.5 * np.log(2 * np.pi)


def parts(seed: int, sizes: tuple[int, ...] = (6, 9), p: int = 5, sigma: float = 0.3) -> tuple[list[Part], np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(sum(sizes), p))
    y = a @ rng.normal(size=p) + rng.normal(0, sigma, sum(sizes))
    cuts = np.cumsum(sizes)[:-1]
    found = [Part(ai / sigma, yi / sigma, len(yi) * np.log(sigma)) for ai, yi in zip(np.split(a, cuts), np.split(y, cuts), strict=True)]
    return found, y, a @ a.T + sigma**2 * np.eye(len(y))


@given(st.integers(0, 10**6))
@settings(max_examples=30, deadline=None)
def test_log_evidence_is_that_of_the_normal_density(seed):
    found, y, covariance = parts(seed)
    whole = stats.multivariate_normal(np.zeros(len(y)), covariance).logpdf(y) + len(y) * CONSTANT
    assert together(found).log_evidence == pytest.approx(whole, rel=1e-8)
    given_first = conditional(together(found[:1]), {"x": found[1]})["x"]
    assert together(found[:1]).log_evidence + given_first == pytest.approx(whole, rel=1e-8)


def test_scatter_finds_the_noise_and_the_outliers():
    rng = np.random.default_rng(4)
    x = np.linspace(-1, 1, 60)
    a = np.polynomial.legendre.legvander(x, 6) * 5e-3
    y = a @ rng.normal(size=7) + rng.normal(0, 3e-4, 60)
    y[[5, 40]] += [8e-3, -20e-3]
    sigma, drop = scatter(Design(a), y)
    assert sigma == pytest.approx(3e-4, rel=0.4)
    assert set(np.flatnonzero(drop)) == {5, 40}


def test_a_clumsy_set_up_a_worn_bar_and_outliers_are_no_reason():
    runs = list(Truth(2).campaign())
    runs[0] = replace(runs[0], deviation_mm=runs[0].deviation_mm + 0.05)  # a bar 50 um too long
    shift = (runs[1].axes_mm - runs[1].centre_mm) @ np.array([0.15, -0.1, 0.05]) / runs[1].radius_mm  # a cup 0.2 mm beside its place
    runs[1] = replace(runs[1], deviation_mm=runs[1].deviation_mm - shift)
    spikes = runs[6].deviation_mm.copy()
    spikes[[3, 9]] += 0.04
    runs[6] = replace(runs[6], deviation_mm=spikes)
    assert suspects(MACHINE, runs) == ()


@pytest.mark.parametrize("seed", [3, 5, 8])
def test_a_run_of_sixteen_times_the_noise_is_suspect_but_no_wrong_unit(seed):
    """Divided by 25.4 it would be quiet, too: that alone proved inches before."""
    runs = list(Truth(seed).campaign())
    noise = np.random.default_rng(seed).normal(0.0, 4e-3, runs[-3].deviation_mm.size)
    runs[-3] = replace(runs[-3], deviation_mm=runs[-3].deviation_mm + noise)
    assert [(s.run, s.cause) for s in suspects(MACHINE, runs)] == [(runs[-3].label, "other")]


def test_two_runs_that_contradict_each_other_are_both_named():
    truth = Truth(5)
    first, second = (truth.bar(n, np.array([300.0, 250.0, 135.0]), 200.0) for n in ("a", "b"))
    found = suspects(MACHINE, [first, replace(second, deviation_mm=-second.deviation_mm)])
    assert {found[0].run, *found[0].tied} == {"a", "b"}


def test_one_run_alone_contradicts_nobody():
    assert suspects(MACHINE, Truth(1).helices()[:1]) == ()
