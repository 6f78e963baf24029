"""Designs of the experiments against simulation of the whole machine, and what noise makes of a map (math.md 4.6, 5.5)."""

import numpy as np
import pytest

from abbe.models.functions.monomials import error_arrays, monomials
from abbe.models.notation.yang import workpiece_mm
from abbe.models.papers.wang.experiments import WangPlan as LaserPlan
from abbe.models.papers.wang.experiments import distance_errors_mm, interpolated_mm, problem, readings
from abbe.models.papers.wang.model import monomial_errors as wang_errors
from abbe.models.papers.wang.model import monomial_field as wang_field
from abbe.models.papers.wang.model import position_error_eq9
from abbe.models.papers.yang.complete import delta_eq1, monomial_errors, monomial_field
from abbe.models.papers.yang.experiments import YangPlan, all_helices, one_helix, origin_plan, step_diagonals, together, vector_map
from abbe.models.solvers.designs import hidden_combination, map_noise_gain, ranks, shortest_solution, stacked

TRAVEL, TOOL = np.array([812.8, 495.0, 508.0]), np.array([0.0, 0.0, 150.0])
ORIGINS = origin_plan(np.stack([np.zeros(3), TRAVEL], axis=1))
PLAN = YangPlan(TRAVEL, TOOL, ORIGINS, (175.0, 100.0), 5.0, 20, 1)


def test_counts_of_coefficients():
    assert [len(monomials(d)) for d in range(1, 6)] == [15, 33, 51, 69, 87]
    assert monomials(2)[1].name == "dxx^2"
    with pytest.raises(ValueError, match="degree"):
        monomials(0)
    with pytest.raises(ValueError, match="coefficients"):
        error_arrays(monomials(1), np.zeros(3), np.zeros((1, 3)))


def test_the_design_is_the_derivative_of_the_model():
    rng = np.random.default_rng(0)
    terms = monomials(3)
    theta = rng.normal(0, 1e-2, len(terms))
    slide = rng.uniform(0, 1, (25, 3)) * TRAVEL
    tool = np.array([30.0, -20.0, 150.0])
    whole = delta_eq1(monomial_errors(terms, theta, slide, TRAVEL), slide, tool)
    assert monomial_field(terms, workpiece_mm(slide), TRAVEL, tool) @ theta == pytest.approx(whole, abs=1e-14)
    p = rng.uniform(0, 1, (25, 3)) * TRAVEL
    small = theta * [1.0 if t.kind == "d" else 2e-3 for t in terms]
    assert wang_field(terms, p, TRAVEL) @ small == pytest.approx(position_error_eq9(wang_errors(terms, small, p, TRAVEL), p), abs=1e-14)


def test_one_bar_length_per_radius_hides_the_common_scale_and_a_shared_one_shows_it():
    names = [t.name for t in monomials(1)]
    scale = [names.index(f"d{a}{a}^1") for a in "xyz"]
    weights, trace = hidden_combination(*all_helices(PLAN, centres=True, lengths="each"), scale)
    assert trace < 1e-12
    assert weights == pytest.approx(TRAVEL / TRAVEL.max(), abs=1e-9)  # full-travel errors of one common scale
    assert hidden_combination(*all_helices(PLAN, centres=True, lengths="common"), scale)[1] > 1e-3


def test_a_second_tool_length_shows_what_one_tool_cannot():
    one, two = vector_map(PLAN, (TOOL,)), vector_map(PLAN, (TOOL, np.array([0.0, 0.0, 250.0])))
    assert (ranks(*one)[0], ranks(*two)[0]) == (11, 14)
    names = [t.name for t in monomials(1)]
    pair = [names.index("eyy^1"), names.index("Sxy^1")]
    weights, trace = hidden_combination(*one, pair)
    assert trace < 1e-12
    assert weights == pytest.approx([1.0, 150.0 / 495.0])
    assert hidden_combination(*two, pair)[1] > 1e-3


def test_noise_gain_is_the_scatter_of_repeated_fits():
    a, setup = together(one_helix(PLAN, setup=True), step_diagonals(PLAN, tilts=True))
    nodes = workpiece_mm(np.array([[100.0, 60.0, 60.0], [700.0, 430.0, 440.0]]))
    predict = PLAN.field()(nodes)
    stated = map_noise_gain(a, setup, predict)
    rng = np.random.default_rng(6)
    x = np.concatenate([a, setup], axis=1)
    norm = np.linalg.norm(x, axis=0)
    scale = 1.0 / np.where(norm > 0, norm, 1.0)
    solve = np.linalg.pinv(x * scale, rcond=1e-9)
    maps = [predict @ (scale * (solve @ rng.normal(0, 1.0, len(x))))[: a.shape[1]] for _ in range(4000)]
    assert np.std(maps, axis=0) == pytest.approx(stated, rel=0.06)


def test_stacking_shares_unknowns_of_equal_number():
    a, s = stacked([np.ones((2, 1)), np.ones((1, 1))], [(np.full((2, 1), 3.0), (1,)), (np.full((1, 1), 4.0), (1,))])
    assert a.shape == (3, 1)
    assert s.tolist() == [[0.0, 3.0], [0.0, 3.0], [0.0, 4.0]]


def test_shortest_solution_obeys_its_scale_only_where_data_are_silent():
    a = np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    y = np.array([3.0, 5.0])
    assert shortest_solution(a, y, np.ones(3)) == pytest.approx([1.5, 1.5, 5.0])
    assert shortest_solution(a, y, np.array([1.0, 0.0, 1.0])) == pytest.approx([3.0, 0.0, 5.0])


def test_rigid_body_fit_with_two_orders_and_two_edges_returns_the_machine():
    travel = np.array([800.0, 500.0, 400.0])
    plan = LaserPlan(travel, 10, 11, ("XYZ", "ZYX"), axes="XYZ", edges=(0, 1))
    terms, rng = monomials(2), np.random.default_rng(3)
    theta = rng.normal(0, 5e-3, len(terms)) * [1.0 if t.kind == "d" else 2e-3 for t in terms]

    def deviation(p):
        return wang_field(terms, p, travel) @ theta

    tilt = {name: rng.normal(0, 1e-4, 2) for name in ("ppp", "npp", "pnp", "ppn")}
    a, setup = problem(plan, 2)
    x = np.concatenate([a, setup], axis=1)
    found = shortest_solution(x, readings(plan, deviation, tilt), np.array([1.0 if t.kind == "d" else 2e-3 for t in terms] + [2e-3] * 16))
    grid = rng.uniform(0, 1, (30, 3)) * travel
    left = distance_errors_mm(grid, wang_field(terms, grid, travel) @ found[: len(terms)], deviation(grid))
    before = distance_errors_mm(grid, np.zeros_like(grid), deviation(grid))
    assert np.abs(before).max() > 5e-3
    assert np.abs(left).max() < 1e-5
    assert found[len(terms) : len(terms) + 2] == pytest.approx(np.tan(tilt["ppp"]), abs=1e-6)


def test_distances_do_not_see_a_rotation_of_the_frame():
    rng = np.random.default_rng(7)
    p = rng.uniform(0, 500, (20, 3))
    turn = np.cross([1e-6, -2e-6, 3e-6], p)
    assert distance_errors_mm(p, turn, np.zeros_like(p)) == pytest.approx(0.0, abs=5e-9)
    stretch = 1e-5 * p
    i, j = np.triu_indices(20, 1)
    assert distance_errors_mm(p, stretch, np.zeros_like(p)) == pytest.approx(1e-5 * np.linalg.norm(p[i] - p[j], axis=1), rel=1e-9)


def test_curves_add_up_between_the_steps():
    e = np.zeros((3, 3, 3))
    e[0, 1] = [0.0, 2.0, 6.0]
    e[2, 0] = [0.0, -1.0, -1.0]
    found = interpolated_mm(np.array([[5.0, 15.0, 0.0]]), np.array([10.0, 10.0, 10.0]), e)
    assert found == pytest.approx(np.array([[4.0, 0.0, -0.5]]))
