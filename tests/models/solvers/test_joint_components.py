"""Variance components against the normal distribution itself, and the prior of the error motions against what it claims."""

import numpy as np
import pytest
from numpy.polynomial import legendre
from scipy import stats

from abbe.models.geometry.bases import smooth_terms
from abbe.models.solvers.components import Components, FittedComponents, InformationSums, cautious, estimate, posterior, slope
from abbe.models.solvers.priors import SMALLEST_BEND, Priors, SizeModel, size_model, smooth_shapes
from tests.models.solvers.truth import MACHINE

FREE = np.full(2, np.inf)
SIZES = SizeModel(
    np.ones(6), np.eye(6), (), (), 0.5, 0.1, ("a", "b"), np.repeat(np.eye(2), 3, axis=0), sd=np.array([2.0, 2.0]), low=-FREE, high=FREE
)


def problem(seed=0, n=(40, 25)):
    rng = np.random.default_rng(seed)
    a = [rng.normal(size=(k, 6)) for k in n]
    x = rng.normal(size=6) * np.repeat([2.0, 0.3], 3)
    y = [m @ x + s * rng.normal(size=len(m)) for m, s in zip(a, (0.5, 2.0), strict=True)]
    parts = [np.stack([m.T @ m for m in a]), np.stack([m.T @ v for m, v in zip(a, y, strict=True)])]
    return a, y, InformationSums(*parts, np.array([v @ v for v in y]), np.array(n, dtype=float))


def log_density(a, y, c):
    """log p(y) of the marginal distribution, by its full covariance."""
    prior = np.exp(SIZES.design @ c.psi)
    noise = np.concatenate([np.full(len(v), np.exp(e)) for v, e in zip(y, c.eta, strict=True)])
    whole = np.concatenate(a)
    return stats.multivariate_normal(None, whole * prior @ whole.T + np.diag(noise)).logpdf(np.concatenate(y))


def test_the_evidence_is_the_density_of_the_readings():
    a, y, sums = problem()
    one, two = Components(np.array([0.3, -1.0]), np.array([-0.5, 0.8])), Components(np.array([1.0, 0.0]), np.array([0.0, 0.2]))
    gap = posterior(sums, one, SIZES).log_evidence - posterior(sums, two, SIZES).log_evidence
    assert gap == pytest.approx(log_density(a, y, one) - log_density(a, y, two), abs=1e-9)


def test_the_gradient_is_that_of_the_evidence():
    _, _, sums = problem(1)
    at = np.array([0.3, -1.0, -0.5, 0.8])

    def value(v):
        return posterior(sums, Components(v[:2], v[2:]), SIZES).log_evidence

    c = Components(at[:2], at[2:])
    found = slope(sums, c, SIZES, posterior(sums, c, SIZES))[0]
    wanted = [(value(at + h) - value(at - h)) / 2e-5 for h in 1e-5 * np.eye(4)]
    assert found == pytest.approx(wanted, abs=1e-6)


def test_noise_and_sizes_come_back_without_bias():
    noise = []
    for seed in range(60):
        _, _, sums = problem(seed)
        noise.append(np.exp(0.5 * estimate(sums, SIZES, Components(np.zeros(2), np.zeros(2))).components.eta))
    assert np.median(noise, axis=0) == pytest.approx([0.5, 2.0], rel=0.1)


def test_sizes_that_are_known_badly_widen_the_prior_and_no_shape_is_held_to_nanometres():
    model = size_model(MACHINE, smooth_terms(6), (), np.ones(0), Priors())
    n, h = model.typical.size, model.sd.size
    size = {"angle": -14.0, "positioning": -1.0, "straightness": -1.0}  # below the documented size, from where ignorance may widen
    small = Components(np.array([size.get(name, 0.0) for name in model.names]), np.zeros(2))
    found = [cautious(model, FittedComponents(small, v * np.eye(h + 2), 0.0)) for v in (1e-12, 0.5)]
    before, known, unknown = (np.linalg.norm(m.root * c.half(m), axis=1) for m, c in ((model, small), *found))
    at = np.concatenate(model.blocks)
    rest = np.setdiff1d(np.arange(n), np.r_[at, np.flatnonzero(model.design[:, model.names.index("slope")])])
    assert before[at].min() < 0.2 * SMALLEST_BEND
    assert known[at].min() >= SMALLEST_BEND
    large = at[before[at] > 0.1]
    assert known[large] == pytest.approx(before[large], rel=1e-3)
    assert (unknown[large] > 1.1 * known[large]).all()
    assert (unknown[rest] == before[rest]).all()
    model_02, c_02 = cautious(model, FittedComponents(small, 0.5 * np.eye(h + 2), 0.0), 0.2)
    part = np.linalg.norm(model_02.root * c_02.half(model_02), axis=1)
    assert (part[large] > 1.01 * known[large]).all()  # a share of the widening is a share of its logarithm
    assert (part[large] < unknown[large]).all()


@pytest.mark.parametrize(("times", "most"), [(0.5, 1.0), (1.0, 1.0), (1.5, 2.25)])
def test_on_a_large_machine_motions_of_unknown_size_may_exceed_the_documented_one_by_its_square(times, most):
    """``most``: prior of the motions in units of the documented one where nothing is known of their sizes; half of it is most probable."""
    model = size_model(MACHINE, smooth_terms(6), (), np.ones(0), Priors(pooled=True))
    size = {"machine": 2.0 * np.log(times)} | dict.fromkeys(("positioning", "straightness", "angle"), 2.0 * np.log(0.5 / times))
    at = np.concatenate(model.blocks)
    c = Components(np.array([size.get(name, 0.0) for name in model.names]), np.zeros(2))
    wider, c = cautious(model, FittedComponents(c, 5.0 * np.eye(model.sd.size + 2), 0.0))
    found = np.linalg.norm(wider.root, axis=0)[at] * c.half(wider)[at] / np.linalg.norm(model.root, axis=0)[at]
    assert np.median(found) == pytest.approx(most, rel=0.02)


def test_an_error_motion_is_at_most_twice_as_large_at_the_ends_as_in_the_middle():
    shapes, variance = smooth_shapes(12, 0.25)
    u = np.linspace(-1.0, 1.0, 21)
    sd = np.linalg.norm(legendre.legvander(u, 12)[:, 2:] @ (shapes * np.sqrt(variance)), axis=1)
    independent = np.linalg.norm(legendre.legvander(u, 12)[:, 2:] * np.linalg.norm(shapes * np.sqrt(variance), axis=1), axis=1)
    assert sd.max() / np.median(sd) < 2.1  # a line was taken away, and a tenth of the variance is largest there
    assert independent.max() / np.median(independent) > 1.5 * sd.max() / np.median(sd)


def test_stated_calibrations_scales_and_squareness_are_never_learned():
    names = ("backlash_X", "cup_a_x", "bar_length_150", "laser_scale", "zero_a", "tilt_a_1")
    terms = smooth_terms(3)
    model = size_model(MACHINE, terms, names, np.ones(len(names)), Priors())
    free = {n for n, row in zip(names, model.design[len(terms) :], strict=True) if row.any()}
    assert free == {"backlash_X", "cup_a_x", "tilt_a_1"}
    fixed = {t.name for t, row in zip(terms, model.design, strict=False) if not row.any()}
    assert fixed == {"EXX.1", "EYY.1", "EZZ.1", "C0Y", "B0Z", "A0Z"}
