"""Monte Carlo of a whole campaign against the law of propagation; stated intervals against machines that the solver does not know.

``ABBE_TEST_LONG=1`` draws more trials, repeatabilities and machines.
"""

import os
from dataclasses import replace

import numpy as np
import pytest

from abbe.models.geometry.volume import RigidFree, rigid_at, rigid_design, volume_frame, volume_grid
from abbe.models.solvers.joint import solve_joint
from abbe.models.solvers.observations import block_average
from abbe.models.uncertainty import campaign_trials as module
from abbe.models.uncertainty.campaign_trials import LIMITS, campaign_trials
from abbe.models.uncertainty.distributions import Distribution
from abbe.models.uncertainty.inputs import StatedInputs
from abbe.models.uncertainty.monte_carlo import VALIDATION_SHARE, adaptive, validate
from abbe.models.uncertainty.prediction import predict_deviation
from abbe.models.uncertainty.sources import error_sources
from tests.experiments.campaigns.population import draw_case
from tests.models.solvers.truth import FLOOR, MACHINE, SIGMA, Truth

LONG = os.environ.get("ABBE_TEST_LONG") == "1"
POINTS = np.random.default_rng(0).uniform(MACHINE.stroke_mm[:, 0] + 40, MACHINE.stroke_mm[:, 1] - 40, (6, 3))
FRAME = RigidFree(volume_grid(MACHINE.stroke_mm, 4))


@pytest.fixture(scope="module")
def solution():
    runs = tuple(block_average(r, 40) if r.kind == "bar" else r for r in Truth(5).campaign())
    return solve_joint(MACHINE, runs, order=4, sigma_mm=SIGMA, floor_mm=FLOOR)


@pytest.fixture(scope="module")
def sources(solution):
    return error_sources(solution, StatedInputs(repeatability_mm=1e-4))


def test_trials_give_the_propagated_uncertainty_and_validate_its_intervals(sources):
    """GUM-S1 8: ends of the 95 % interval agree within half a unit of the first digit of u; u within its sampling error."""
    points = POINTS[:2] if LONG else np.array([[280.0, 230.0, 220.0]])  # there all u have a small first digit: fewer trials judge them
    draw = campaign_trials(sources, points, frame=FRAME).linear()
    found = adaptive(draw, np.random.default_rng(1), digits=1, share=VALIDATION_SHARE, largest=400_000)
    p = predict_deviation(sources, points, frame=FRAME)
    assert validate(p.deviation_mm.ravel(), p.expanded_mm.ravel(), found).valid.all()
    np.testing.assert_allclose(found.u, p.u_mm.ravel(), rtol=5.0 / np.sqrt(2.0 * found.trials))
    assert np.abs((found.mean - p.deviation_mm.ravel()) / found.u).max() < 5.0 / np.sqrt(found.trials)
    correlation = found.covariance[0, 1] / found.u[0] / found.u[1]
    assert correlation == pytest.approx(p.covariance_mm2[0, 0, 1] / p.u_mm[0, 0] / p.u_mm[0, 1], abs=0.04)


def test_trials_through_the_exact_readings_are_those_through_the_gain(sources):
    """Finite rotations, the length of the bar, the tilted mirror: for the same draws they change a prediction by less than 1 % of u."""
    trials = campaign_trials(sources, POINTS, frame=FRAME)
    linear, exact = (draw(np.random.default_rng(2), 15) for draw in (trials.linear(), trials.exact()))
    u = predict_deviation(sources, POINTS, frame=FRAME).u_mm.ravel()
    assert np.abs((exact - linear) / u).max() < 0.01
    assert np.abs((linear - linear.mean(axis=0)) / u).max() > 1.0  # they did draw something


def test_limits_make_shorter_intervals_than_the_law_of_propagation_says(solution):
    """Temperatures stated as limits and large: the interval of a rectangle ends at 1.65 u, and the propagated one is not valid."""
    hot = error_sources(solution, StatedInputs(u_scale_temperature_k=2.0))
    point = np.array([[580.0, 20.0, 20.0]])
    p = predict_deviation(hot, point, frame=FRAME)
    draw = campaign_trials(hot, point, frame=FRAME, distributions=LIMITS).linear()
    found = adaptive(draw, np.random.default_rng(3), digits=1, share=VALIDATION_SHARE, largest=400_000)
    assert found.u[0] == pytest.approx(p.u_mm[0, 0], rel=0.02)
    assert (found.symmetric.width / found.u)[0] < 2 * 1.75
    assert not validate(p.deviation_mm.ravel(), p.expanded_mm.ravel(), found).valid[0]


@pytest.mark.parametrize("repeatability_mm", [1e-4, 5e-4, 3e-3] if LONG else [1e-4, 3e-3])
def test_repeatability_counts_once_however_large_it_is_stated(solution, repeatability_mm):
    """3 um stated for readings that scatter by less: the law of propagation and trials of the readings agree all the same."""
    inputs = replace(StatedInputs().without_stated_inputs(), repeatability_mm=repeatability_mm)
    stated, none = error_sources(solution, inputs), error_sources(solution, StatedInputs().without_stated_inputs())
    u, without = (predict_deviation(s, POINTS, frame=FRAME).u_mm for s in (stated, none))
    np.testing.assert_allclose(u, without, rtol=1e-9)
    drawn = campaign_trials(stated, POINTS, frame=FRAME).linear()(np.random.default_rng(1), 20_000)
    np.testing.assert_allclose(drawn.std(axis=0), u.ravel(), rtol=5.0 / np.sqrt(2.0 * len(drawn)))


def test_trials_of_a_point_do_not_depend_on_the_points_beside_it(solution):
    """What the estimated sizes add is cut at nothing point by point, as the law has it: 200 other points change nothing."""
    sources = error_sources(solution, StatedInputs().without_stated_inputs())
    others = np.random.default_rng(3).uniform(MACHINE.stroke_mm[:, 0], MACHINE.stroke_mm[:, 1], (200, 3))
    alone, among = (
        campaign_trials(sources, p, frame=FRAME).linear()(np.random.default_rng(1), 300)[:, :18] for p in (POINTS, np.r_[POINTS, others])
    )
    np.testing.assert_allclose(among, alone, rtol=1e-5, atol=1e-9)
    size = dict(campaign_trials(sources, others, frame=FRAME)._others())["estimated_sizes"]
    p = predict_deviation(sources, others, frame=FRAME)
    law = p.variance_mm2[p.names.index("estimated_sizes")].ravel()
    np.testing.assert_allclose((size**2).sum(axis=0), law, rtol=1e-6, atol=1e-6 * law.max())


def test_readings_are_drawn_in_parts_and_too_many_points_are_refused(sources, monkeypatch):
    trials = campaign_trials(sources, POINTS, frame=FRAME)
    whole = trials.linear()(np.random.default_rng(6), 200)
    monkeypatch.setattr(module, "CHUNK_READINGS", 7 * trials.response.weight.size)
    parts = trials.linear()(np.random.default_rng(6), 200)
    np.testing.assert_allclose(parts.std(), whole.std(), rtol=0.1)  # other draws of the same readings
    monkeypatch.setattr(module, "MOST_POINTS", 5)
    with pytest.raises(ValueError, match="6 points need too much memory"):
        campaign_trials(sources, POINTS)
    with pytest.raises(ValueError, match="finite numbers"):
        campaign_trials(sources, np.full((1, 3), np.nan))


def test_one_approach_scatters_more_than_the_mean_of_many(solution):
    many, once = (error_sources(solution, StatedInputs(repeatability_mm=5e-4, single_approach=s)) for s in (False, True))
    u = [adaptive(campaign_trials(s, POINTS[:1]).linear(), np.random.default_rng(4), largest=10_000).u for s in (many, once)]
    np.testing.assert_allclose(u[1] ** 2 - u[0] ** 2, 25e-8, atol=0.1 * (u[0] ** 2).max())


def test_the_same_seed_gives_the_same_trials_and_shapes_of_noise_are_taken(sources):
    trials = campaign_trials(sources, POINTS, distributions={"laser_noise": Distribution("rectangular")})
    one, two = (trials.linear()(np.random.default_rng(6), 50) for _ in range(2))
    np.testing.assert_array_equal(one, two)
    assert not np.array_equal(one, campaign_trials(sources, POINTS).linear()(np.random.default_rng(6), 50))


def test_intervals_hold_the_truth_of_machines_that_the_solver_does_not_know():
    """Independent simulator, one machine (two in the long run) x 3 kinds of campaign, data alone. A wrong bar or wavelength misses
    everywhere at once, so few machines do not average to 95 %: the referee's table (tests/experiments/campaigns) counts hundreds."""
    held, smaller = [], []
    for seed in (0, 1) if LONG else (0,):
        for kind in ("joint", "one_tool", "laser_only") if LONG else ("joint", "laser_only"):
            case = draw_case(seed, kind)
            frame = volume_frame(case.machine)
            inside = np.random.default_rng(seed).uniform(0.05, 0.95, (100, 3))
            points = case.machine.stroke_mm[:, 0] + case.machine.length_mm * inside
            sources = error_sources(solve_joint(case.machine, case.runs), StatedInputs().without_stated_inputs())
            p = predict_deviation(sources, points, frame=frame)
            truth = case.truth.deviation_mm(np.concatenate([frame.reference_mm, points]))
            at = len(frame.reference_mm)
            motion = np.linalg.lstsq(rigid_design(frame.reference_mm).reshape(-1, 6), truth[:at].ravel(), rcond=None)[0]
            left = truth[at:] - rigid_at(points, frame.reference_mm) @ motion
            held.append(float((np.abs(p.deviation_mm - left) < p.expanded_mm).mean()))
            smaller.append(float(np.sqrt((p.u_mm**2).mean() / (left**2).mean())))
    assert np.mean(held) > 0.93
    assert min(held) > 0.8
    # Intervals that hold everything because they are wide would say nothing; seen .05, .08 and, for the laser alone, .21.
    assert max(smaller) < 0.25
