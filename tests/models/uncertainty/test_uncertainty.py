"""Uncertainty of predicted deviations: every source by itself against an independent calculation, and all of them together."""

from dataclasses import replace

import numpy as np
import pytest

from abbe.models.geometry.bases import SMOOTH_ORDER, rough_terms, smooth_terms
from abbe.models.geometry.chain import design
from abbe.models.geometry.volume import RigidFree, remove_rigid, rigid_at, volume_frame, volume_grid
from abbe.models.solvers.joint import solve_joint
from abbe.models.solvers.least_squares import solve_map
from abbe.models.solvers.observe import run_design
from abbe.models.uncertainty import prediction as module
from abbe.models.uncertainty.inputs import STEEL_PER_K, StatedInputs
from abbe.models.uncertainty.prediction import budget_over, compensable_mask, predict_deviation
from abbe.models.uncertainty.sources import SOURCE_TEXTS, error_sources, omitted_prior_sd, omitted_terms, response
from tests.models.solvers.truth import FLOOR, MACHINE, SIGMA, Truth

GRID = volume_grid(MACHINE.stroke_mm, 4)


@pytest.fixture(scope="module")
def truth():
    return Truth(3)


@pytest.fixture(scope="module")
def runs(truth):
    return truth.campaign()


@pytest.fixture(scope="module")
def solution(runs):
    return solve_joint(MACHINE, runs, order=5, sigma_mm=SIGMA, floor_mm=FLOOR)


def test_sources_of_the_data_add_up_to_the_covariance_of_the_solution(solution):
    """Noise and priors without remainder; with the widening for estimated sizes never below what the solver states, and hardly above."""
    sources = error_sources(solution, StatedInputs().without_stated_inputs())
    r = response(solution)
    n = len(solution.terms)
    sd = np.sqrt(np.diag(r.covariance)[:n])
    parts = [s.factor @ s.factor.T for s in sources.sources if s.name != "estimated_sizes"]
    assert np.abs((sum(parts) - r.covariance[:n, :n]) / np.outer(sd, sd)).max() < 1e-8
    p = predict_deviation(sources, GRID[1:])
    d = design(MACHINE, solution.terms, GRID[1:])
    stated = np.sqrt(np.einsum("mik,kl,mil->mi", d, solution.term_covariance, d))
    assert (p.u_mm / stated).min() > 1.0 - 1e-6
    assert (p.u_mm / stated).max() < 1.1  # what makes no prediction better is wider in some direction of a point
    assert np.median(p.u_mm / stated) < 1.01
    np.testing.assert_allclose(p.variance_mm2.sum(axis=0), p.u_mm**2, rtol=1e-12)


def test_weights_of_the_solution_are_those_of_its_information(solution):
    r = response(solution)
    information = r.design.T @ (r.design * r.weight[:, None])
    size = np.sqrt(np.diag(information)) + 1e-300
    assert np.abs((information - solution.information) / np.outer(size, size)).max() < 1e-10
    assert set(r.kind) == {"bar", "laser"}


def test_an_error_of_the_readings_moves_the_estimate_as_another_solver_says(solution):
    r = response(solution)
    used = r.weight > 0
    e = np.random.default_rng(8).normal(0.0, 1e-3, r.weight.size)
    sigma = 1.0 / np.sqrt(r.weight[used])
    root = solution.prior_root
    other = root @ solve_map(solution.estimate.names, r.design[used] @ root, e[used], sigma, np.ones(len(root))).theta
    u = np.sqrt(np.diag(r.covariance))
    assert np.abs((r.of_readings(e) - other) / u).max() < 1e-6
    assert np.abs((r.gain @ e - other) / u).max() < 1e-6


def test_prediction_is_that_of_the_solution_for_any_tool(solution):
    sources = error_sources(solution)
    tool = np.array([10.0, -5.0, -260.0])
    for given in (None, tool):
        p = predict_deviation(sources, GRID, tool_mm=given)
        np.testing.assert_allclose(p.deviation_mm, solution.deviation_mm(GRID, given), atol=1e-15)
    longer = predict_deviation(sources, GRID, tool_mm=tool, frame=volume_frame(MACHINE))
    same = predict_deviation(sources, GRID, frame=volume_frame(MACHINE))
    assert budget_over(longer).u_mm > budget_over(same).u_mm  # the levers of the rotations grow
    assert solution.tool_count == 1


def test_rigid_free_frame_is_that_of_remove_rigid_and_holds_less(solution):
    sources = error_sources(solution)
    own, free = (predict_deviation(sources, GRID, frame=f) for f in (None, RigidFree(GRID)))
    np.testing.assert_allclose(free.deviation_mm, remove_rigid(GRID, own.deviation_mm), atol=1e-12)
    assert budget_over(free).u_mm < 0.5 * budget_over(own).u_mm
    line = np.array([300.0, 200.0, 100.0]) + np.outer(np.arange(3), [10.0, 0, 0])
    np.testing.assert_allclose(rigid_at(GRID, GRID).reshape(-1, 6), rigid_at(GRID[::-1], GRID).reshape(64, 3, 6)[::-1].reshape(-1, 6))
    assert predict_deviation(sources, line, frame=RigidFree(GRID)).u_mm.shape == (3, 3)


def test_scale_temperature_is_expansion_times_travel(solution):
    """alpha u_T (x - start), each axis by itself, in the machine's own frame (positioning is zero at the start of the stroke)."""
    p = predict_deviation(error_sources(solution, StatedInputs(u_scale_temperature_k=0.5)), GRID)
    u = np.sqrt(p.variance_mm2[p.names.index("scale_temperature")])
    np.testing.assert_allclose(u, 0.5 * STEEL_PER_K * (GRID - MACHINE.stroke_mm[:, 0]), atol=1e-12)


def test_a_wrong_wavelength_is_a_wrong_scale(truth):
    """Laser runs alone: one ppm of wavelength makes every distance wrong by one ppm, whether the solver has it as unknown or not."""
    lasers = tuple(r for r in truth.campaign() if r.kind == "laser")
    s = solve_joint(MACHINE, lasers, order=4, sigma_mm=SIGMA, floor_mm=FLOOR)
    sources = error_sources(s)
    scale = float(s.prior_sd[s.estimate.names.index("laser_scale")])
    p = predict_deviation(sources, GRID, frame=RigidFree(GRID))
    u = np.sqrt(p.variance_mm2[p.names.index("wavelength")])
    np.testing.assert_allclose(u, scale * np.abs(GRID - GRID.mean(axis=0)), atol=0.15 * scale * 300)
    assert "bar_noise" not in p.names


def test_bar_length_counts_where_nothing_else_gives_a_scale(truth):
    """Ball-bars alone: the bar's calibration carries the scale; with lasers in the campaign it hardly matters."""
    bars = tuple(r for r in truth.campaign() if r.kind == "bar")
    alone = error_sources(solve_joint(MACHINE, bars, order=3, sigma_mm=SIGMA, floor_mm=FLOOR))
    joint = error_sources(solve_joint(MACHINE, truth.campaign(), order=3, sigma_mm=SIGMA, floor_mm=FLOOR))
    lines = [budget_over(predict_deviation(s, GRID, frame=RigidFree(GRID))).line("bar_length").u_mm for s in (alone, joint)]
    assert lines[0] > 10 * lines[1]
    assert lines[0] > 1e-3


def test_bar_temperature_acts_as_a_longer_bar(solution):
    """alpha u_T R of each bar: the change of the estimate when every bar reading is longer by that."""
    r = response(solution)
    inputs = replace(StatedInputs().without_stated_inputs(), u_bar_temperature_k=2.0)
    source = error_sources(solution, inputs).source("bar_temperature")
    longer = np.concatenate([np.full(run.deviation_mm.size, 2.0 * STEEL_PER_K * (run.radius_mm or 0.0)) for run in solution.data])
    root, n = solution.prior_root, len(solution.terms)
    sigma = 1.0 / np.sqrt(r.weight)
    moved = root @ solve_map(solution.estimate.names, r.design @ root, longer, sigma, np.ones(len(root))).theta  # another solver
    u = np.sqrt(np.diag(r.covariance)[:n])
    assert np.abs((source.factor[:, 0] - moved[:n]) / u).max() < 1e-6
    assert np.abs(moved[:n] / u).max() > 1e-3


def test_repeatability_takes_its_share_out_of_the_readings_and_adds_to_a_single_approach(solution):
    data = StatedInputs().without_stated_inputs()
    total = predict_deviation(error_sources(solution, data), GRID)
    small = predict_deviation(error_sources(solution, replace(data, repeatability_mm=5e-5)), GRID)
    np.testing.assert_allclose(small.u_mm, total.u_mm, rtol=1e-9)
    assert "repeatability" in small.names
    once = predict_deviation(error_sources(solution, replace(data, repeatability_mm=5e-5, single_approach=True)), GRID)
    np.testing.assert_allclose(once.u_mm**2, total.u_mm**2 + 25e-10, rtol=1e-9)


def test_every_source_has_words_and_degrees_of_freedom(solution):
    inputs = StatedInputs(repeatability_mm=1e-4, repeatability_dof=9.0)
    sources = error_sources(solution, inputs)
    assert {s.name for s in sources.sources} == set(SOURCE_TEXTS) - {"table", "scale_drift", "artefact_noise"}  # none acted here
    assert sources.source("repeatability").dof == 9.0
    assert sources.source("scale_temperature").dof == np.inf
    assert sources.source("estimated_sizes").dof == np.inf  # it is the allowance for few degrees of freedom itself
    assert np.isfinite(sources.source("laser_noise").dof)
    r = response(solution)
    parts = [sources.source(f"{kind}_noise").dof for kind in ("bar", "laser")]
    assert sum(parts) == pytest.approx(r.dof)
    assert all(p < n for p, n in zip(parts, [(r.kind == k).sum() for k in ("bar", "laser")], strict=True))
    with pytest.raises(KeyError):
        sources.source("moon")
    k = predict_deviation(sources, GRID).coverage_factor
    assert (k >= 1.9599).all()


def test_order_that_was_left_out_is_allowed_for(truth, runs):
    """Forced to order 2 on a machine of waves: what is above is not solved, and its allowance holds the truth where the rest does not."""
    s = solve_joint(MACHINE, runs, order=2, sigma_mm=SIGMA, floor_mm=FLOOR)
    frame = RigidFree(GRID)
    missed = remove_rigid(GRID, truth.deviation(GRID)) - remove_rigid(GRID, s.deviation_mm(GRID))
    held = []
    for orders in (0, 6):
        p = predict_deviation(error_sources(s, replace(StatedInputs().without_stated_inputs(), orders_above=orders)), GRID, frame=frame)
        held.append(float((np.abs(missed) < p.expanded_mm).mean()))
    assert held[1] > 0.93
    assert held[0] < held[1] - 0.1


def test_orders_are_omitted_above_smooth_motions_only():
    smooth = smooth_terms(SMOOTH_ORDER)
    assert {t.order for t in omitted_terms(smooth, 4)} == {13, 14, 15, 16}
    assert omitted_terms((*smooth, *rough_terms()), 4) == ()


def test_omitted_orders_cost_what_a_solution_with_them_says(solution, runs):
    """Prior share of orders above: the joint solution of both, with the same sizes, has the same covariance of the prediction."""
    extra = 2
    sources = error_sources(solution, replace(StatedInputs().without_stated_inputs(), orders_above=extra))
    r, n = response(solution), len(solution.terms)
    above = sources.terms[n:]
    b = np.concatenate([run_design(MACHINE, above, run, solution.setup)[:, : len(above)] for run in solution.data])
    a = np.concatenate([r.design, b], axis=1)
    sd = omitted_prior_sd(solution, above)
    prior = np.zeros((a.shape[1], a.shape[1]))
    prior[: len(r.covariance), : len(r.covariance)] = solution.prior_root
    prior[len(r.covariance) :, len(r.covariance) :] = np.diag(sd)
    normal = np.eye(a.shape[1]) + prior.T @ (a * r.weight[:, None]).T @ a @ prior
    inverse = prior @ np.linalg.solve(normal, prior.T)
    keep = np.r_[0:n, len(solution.prior_sd) : a.shape[1]]
    d = design(MACHINE, sources.terms, GRID)
    both = np.einsum("mik,kl,mil->mi", d, inverse[np.ix_(keep, keep)], d)
    alone = np.einsum("mik,kl,mil->mi", d[:, :, :n], r.covariance[:n, :n], d[:, :, :n])
    j = d @ sources.source("model_order").factor[:, :-1]  # the last column is what the residuals ask for
    carried = sum(1 for t in solution.terms if t.order > solution.order)
    assert carried == 0
    np.testing.assert_allclose((j**2).sum(axis=2), both - alone, rtol=1e-5, atol=1e-14)


def test_covariance_along_a_direction_and_of_the_vector(solution):
    p = predict_deviation(error_sources(solution), GRID, frame=RigidFree(GRID))
    value, u = p.along(np.array([0.0, 1.0, 0.0]))
    np.testing.assert_allclose(value, p.deviation_mm[:, 1])
    np.testing.assert_allclose(u, p.u_mm[:, 1])
    np.testing.assert_allclose(p.u_vector_mm**2, (p.u_mm**2).sum(axis=1))
    assert (p.expanded_vector_mm > p.expanded_mm.max(axis=1)).all()
    mask = compensable_mask(p)
    assert mask.share > 0.8


@pytest.mark.parametrize("points", [np.zeros((2, 2)), np.full((1, 3), np.nan)])
def test_points_that_are_none_are_refused(solution, points):
    with pytest.raises(ValueError, match="points_mm"):
        predict_deviation(error_sources(solution), points)


def test_a_rigid_frame_needs_three_points():
    with pytest.raises(ValueError, match="rigid-free"):
        RigidFree(np.zeros((2, 3)))


def test_many_points_are_worked_in_parts(solution, monkeypatch):
    sources = error_sources(solution)
    whole = predict_deviation(sources, GRID)
    monkeypatch.setattr(module, "CHUNK_POINTS", 7)
    np.testing.assert_allclose(predict_deviation(sources, GRID).covariance_mm2, whole.covariance_mm2, rtol=1e-12, atol=1e-18)
