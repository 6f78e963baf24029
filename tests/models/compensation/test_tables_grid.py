"""The 3-D grid on a machine that the solver cannot represent: best node values, what they leave on the true machine, rounding."""

import os

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from abbe.models.compensation.additive import additive
from abbe.models.compensation.distances import correction_error_mm, figures, inner_box_mm, pair_design, predict_distances, random_pairs
from abbe.models.compensation.grid import (
    cells,
    fit_positions,
    grid_table,
    node_design,
    nodes_mm,
    quantise_grid,
    trilinear,
)
from abbe.models.compensation.nine_tables import model_uncertainty_mm, nine_tables
from abbe.models.compensation.tables import grid_positions
from abbe.models.geometry.chain import design
from abbe.models.geometry.volume import RigidFree, remove_rigid, rigid_design, volume_grid
from abbe.models.solvers.joint import solve_joint
from abbe.models.solvers.observations import block_average
from abbe.models.uncertainty.inputs import StatedInputs
from abbe.models.uncertainty.prediction import compensable_mask, predict_deviation
from abbe.models.uncertainty.sources import error_sources
from tests.models.solvers.truth import MACHINE, Truth

PAIRS = random_pairs(inner_box_mm(MACHINE), 3000, seed=5)


@pytest.fixture(scope="module")
def solved(solved_truth):
    return solved_truth(2)


@pytest.fixture(scope="module")
def sources(solved):
    """What every table and figure would work out by itself."""
    return error_sources(solved[1])


def true_distances(truth, correction=None):
    """Errors of the distances on the true machine with a correction added to every command."""

    def off(p):
        add = np.zeros_like(p) if correction is None else correction(p)
        return truth.deviation(p + add) + add

    return figures(PAIRS.error_mm(off(PAIRS.first_mm), off(PAIRS.second_mm)))


@given(st.integers(0, 2**32 - 1))
def test_trilinear_is_exact_at_nodes_never_outside_the_nodes_values_and_holds_the_surface(seed):
    rng = np.random.default_rng(seed)
    nodes = tuple(np.cumsum(rng.uniform(0.1, 10.0, n)) for n in rng.integers(2, 6, 3))
    values = rng.normal(size=(*(n.size for n in nodes), 2))
    assert trilinear(nodes, values, nodes_mm(nodes)) == pytest.approx(values.reshape(-1, 2), abs=1e-12)
    p = rng.uniform(-5.0, 60.0, (50, 3))
    found = trilinear(nodes, values, p)
    assert (found <= values.reshape(-1, 2).max(axis=0) + 1e-12).all()
    assert (found >= values.reshape(-1, 2).min(axis=0) - 1e-12).all()
    held = np.clip(p, [n[0] for n in nodes], [n[-1] for n in nodes])
    assert found == pytest.approx(trilinear(nodes, values, held), abs=1e-12)


@given(st.integers(0, 2**32 - 1))
def test_trilinear_follows_products_of_straight_lines_exactly(seed):
    rng = np.random.default_rng(seed)
    nodes = tuple(np.cumsum(rng.uniform(0.1, 10.0, n)) for n in rng.integers(2, 6, 3))
    k = rng.normal(size=8)

    def field(p):
        x, y, z = p.T
        return (k @ np.array([np.ones_like(x), x, y, z, x * y, y * z, z * x, x * y * z]))[:, None]

    p = rng.uniform([n[0] for n in nodes], [n[-1] for n in nodes], (40, 3))
    values = field(nodes_mm(nodes)).reshape(*(n.size for n in nodes), 1)
    assert trilinear(nodes, values, p) == pytest.approx(field(p), abs=1e-8)


def test_the_fit_along_each_terms_axis_is_the_fit_over_the_whole_volume(solved):
    _, s = solved
    position = grid_positions(MACHINE, (4, 3, 3))
    p = nodes_mm(tuple(fit_positions(g) for g in position))
    hat = np.ones((len(p), 4, 3, 3))
    for a, g in enumerate(position):
        index, share = cells(g, p[:, a])
        one = np.zeros((len(p), g.size))
        one[np.arange(len(p)), index], one[np.arange(len(p)), index + 1] = 1 - share, share
        hat *= one.reshape(len(p), *(g.size if k == a else 1 for k in range(3)))
    want = np.linalg.lstsq(hat.reshape(len(p), -1), design(MACHINE, s.terms, p).reshape(len(p), -1), rcond=None)[0]
    found = node_design(s, position).reshape(36, -1)
    assert found == pytest.approx(want, abs=1e-9 * np.abs(want).max())


@pytest.mark.parametrize("nodes", [5, 9])
def test_fitted_nodes_leave_less_on_the_true_machine_than_sampled_ones(solved, sources, nodes):
    truth, s = solved
    fitted, sampled = (true_distances(truth, grid_table(s, (nodes,) * 3, fitted=f, sources=sources).correction_at) for f in (True, False))
    assert fitted.rms_mm < 0.75 * sampled.rms_mm  # seen: 0.63, 0.65
    assert fitted.max_mm < 0.85 * sampled.max_mm  # seen: 0.63, 0.75


def test_the_grid_takes_what_nine_tables_cannot(solved, sources):
    truth, s = solved
    before, after = (
        true_distances(truth),
        true_distances(truth, quantise_grid(grid_table(s, (13, 13, 13), sources=sources), 1e-4).correction_at),
    )
    assert before.rms_mm / after.rms_mm > 50  # seen: about 100
    assert before.max_mm / after.max_mm > 30


def test_the_predicted_distances_hold_on_the_true_machine(solved):
    truth, s = solved
    sources = error_sources(s, StatedInputs().as_measured())  # this truth is as warm in use as in the campaign
    for nodes in (5, 9, 13) if os.environ.get("ABBE_TEST_LONG") == "1" else (5, 13):
        table = grid_table(s, (nodes,) * 3, sources=sources)
        stated, seen = predict_distances(s, table.correction_at, pairs=PAIRS, sources=sources), true_distances(truth, table.correction_at)
        assert seen.rms_mm < stated.rms_mm + 3 * stated.u_rms_mm
        assert seen.rms_mm > 0.4 * stated.rms_mm  # not so wide that it says nothing
        assert stated.rms_mm == pytest.approx(np.hypot(stated.known_mm, stated.unknown_mm), rel=0.1)
    before = predict_distances(s, pairs=PAIRS, sources=sources)
    assert true_distances(truth).rms_mm == pytest.approx(before.rms_mm, abs=3 * before.u_rms_mm + 0.01 * before.rms_mm)


@pytest.fixture(scope="module", params=[{"order": 1}, {"model": "rigid6"}], ids=["order 1", "rigid6"])
def too_simple(request):
    truth = Truth(5)
    runs = tuple(block_average(r, 100) if r.kind == "bar" else r for r in truth.campaign())
    return truth, solve_joint(MACHINE, runs, **request.param)


def test_a_model_that_is_too_simple_says_so_in_all_its_figures(too_simple):
    """The noise alone would state 0.6 um of distances where 3.4 um are left, and intervals of the nodes that hold a third of them."""
    truth, s = too_simple
    table = grid_table(s, (9, 9, 9))
    stated, seen = predict_distances(s, table.correction_at, pairs=PAIRS), true_distances(truth, table.correction_at)
    assert abs(stated.rms_mm - seen.rms_mm) < 2 * stated.u_rms_mm
    assert 0.5 * seen.rms_mm < stated.rms_mm < 2 * seen.rms_mm
    nine = nine_tables(s, (25, 21, 19))
    stated, seen = predict_distances(s, nine.correction_at, pairs=PAIRS), true_distances(truth, nine.correction_at)
    assert abs(stated.rms_mm - seen.rms_mm) < 2 * stated.u_rms_mm
    p = nodes_mm(table.position_mm)
    missed = remove_rigid(p, truth.deviation(p) - s.deviation_mm(p))
    assert np.mean(np.abs(missed) < 1.96 * table.u_mm.reshape(-1, 3)) > 0.93
    assert model_uncertainty_mm(s) > 0.8 * np.sqrt(np.mean(np.sum(missed**2, axis=1)))


def test_uncertainties_of_one_axis_entries_hold_the_truth_of_a_model_that_is_too_simple(too_simple):
    truth, s = too_simple
    nine = nine_tables(s, (13, 11, 10))
    best = additive(lambda p: truth.deviation(p)[:, :, None], MACHINE.stroke_mm, nine.position_mm, nodes=9, order=2)
    grid = volume_grid(MACHINE.stroke_mm, 9)
    gap = truth.deviation(grid) - s.deviation_mm(grid)
    rotation = np.linalg.lstsq(rigid_design(grid).reshape(-1, 6), gap.ravel(), rcond=None)[0][3:]
    held = []
    for a, p in enumerate(nine.position_mm):
        error = (best[a] - best[a][0])[:, :, 0] + nine.correction_mm[a] - np.outer(p - p[0], np.cross(rotation, np.eye(3)[a]))
        held.append((np.abs(error[1:]) < 1.96 * nine.u_mm[a][1:]).ravel())
    assert np.mean(np.concatenate(held)) > 0.9


def test_table_and_mask_judge_by_the_same_uncertainty(too_simple):
    _, s = too_simple
    table, p = grid_table(s, (5, 5, 5)), nodes_mm(grid_positions(MACHINE, (5, 5, 5)))
    deviation = remove_rigid(p, s.deviation_mm(p))
    by_table = np.abs(deviation) > 1.96 * table.u_mm.reshape(-1, 3)
    prediction = predict_deviation(error_sources(s), p, frame=RigidFree(p))
    assert (by_table == compensable_mask(prediction, k=1.96).components).all()


def test_stated_inputs_are_in_the_uncertainties_of_tables_and_can_be_given(solved):
    _, s = solved
    warm, sure = (error_sources(s, StatedInputs(u_scale_temperature_k=u)) for u in (2.0, 0.0))
    for of in (
        lambda x: grid_table(s, (3, 3, 3), sources=x).u_mm.max(),
        lambda x: nine_tables(s, (5, 5, 5), sources=x).u_mm[0][:, 0].max(),
        lambda x: predict_distances(s, sources=x).unknown_mm,
        lambda x: model_uncertainty_mm(s, sources=x),
    ):
        assert of(warm) > 5 * of(sure)


def test_uncertainties_of_the_nodes_are_those_of_the_field_without_rigid_motion(solved):
    _, s = solved
    table = grid_table(s, (4, 4, 4), sources=error_sources(s, StatedInputs().without_stated_inputs()))
    p = nodes_mm(table.position_mm)
    root = np.linalg.cholesky(s.term_covariance + 1e-30 * np.eye(len(s.terms)))
    drawn = design(MACHINE, s.terms, p) @ root @ np.random.default_rng(1).standard_normal((len(s.terms), 2000))
    seen = np.std([remove_rigid(p, drawn[:, :, k]) for k in range(drawn.shape[2])], axis=0)
    assert table.u_mm.reshape(-1, 3) == pytest.approx(seen, rel=0.1)


def test_the_reference_is_not_moved_and_the_frame_is_free_of_rigid_motion(solved, sources):
    _, s = solved
    for reference in ((0, 0, 0), (4, 2, 1)):
        table = grid_table(s, (7, 6, 5), reference=reference, sources=sources)
        assert np.abs(table.correction_mm[reference]).max() == 0.0
        p, c = nodes_mm(table.position_mm), table.correction_mm.reshape(-1, 3)
        assert remove_rigid(p, c) == pytest.approx(c - c.mean(axis=0), abs=1e-6)
    other = grid_table(s, (7, 6, 5), sources=sources)
    assert correction_error_mm(other.correction_at, PAIRS) == pytest.approx(correction_error_mm(table.correction_at, PAIRS), abs=1e-12)


def test_rounding_costs_what_is_stated_and_keeps_the_reference(solved, sources):
    _, s = solved
    table, lsb = grid_table(s, (9, 9, 9), sources=sources), 1e-3
    stored = quantise_grid(table, lsb)
    assert np.abs(np.remainder(stored.correction_mm / lsb + 0.5, 1.0) - 0.5).max() < 1e-9
    assert np.abs(stored.correction_mm[0, 0, 0]).max() == 0.0
    p = np.random.default_rng(3).uniform(MACHINE.stroke_mm[:, 0], MACHINE.stroke_mm[:, 1], (20000, 3))
    off = stored.correction_at(p) - table.correction_at(p)
    # trilinear interpolation averages the rounding, lsb / sqrt(12), of eight nodes: (2/3)^(3/2) of it as rms over a cell
    rounding_mm = lsb / np.sqrt(12.0) * (2.0 / 3.0) ** 1.5
    assert np.sqrt(np.mean(off**2)) == pytest.approx(rounding_mm, rel=0.1)
    added = correction_error_mm(stored.correction_at, PAIRS) - correction_error_mm(table.correction_at, PAIRS)
    assert np.sqrt(np.mean(added**2)) == pytest.approx(np.sqrt(2) * rounding_mm, rel=0.15)


def test_acting_at_the_command_instead_of_the_corrected_position_is_second_order(solved, sources):
    truth, s = solved
    table = grid_table(s, (13, 13, 13), sources=sources)
    p = volume_grid(MACHINE.stroke_mm, 6)
    c = table.correction_at(p)
    assert np.abs(truth.deviation(p + c) - truth.deviation(p)).max() < 2e-5


def test_distances_of_pairs_are_exact_and_feel_no_rigid_motion(solved):
    _, s = solved
    rng = np.random.default_rng(8)
    first, second = rng.normal(0, 0.03, (2, *PAIRS.first_mm.shape))
    want = np.linalg.norm(PAIRS.second_mm + second - PAIRS.first_mm - first, axis=1) - np.linalg.norm(
        PAIRS.second_mm - PAIRS.first_mm, axis=1
    )
    assert PAIRS.error_mm(first, second) == pytest.approx(want, abs=1e-11)
    turned = [np.cross(p, [1e-4, -2e-4, 3e-4]) + 0.5 for p in (PAIRS.first_mm, PAIRS.second_mm)]
    assert np.abs(np.einsum("ni,ni->n", PAIRS.unit, turned[1] - turned[0])).max() < 1e-12
    linear = pair_design(MACHINE, s.terms, PAIRS) @ s.coefficients
    assert linear == pytest.approx(PAIRS.error_mm(s.deviation_mm(PAIRS.first_mm), s.deviation_mm(PAIRS.second_mm)), abs=1e-4)


def test_the_same_solution_gives_the_same_figures(solved):
    _, s = solved
    assert predict_distances(s) == predict_distances(s)


def test_a_grid_that_cannot_be_is_refused(solved, sources):
    _, s = solved
    with pytest.raises(ValueError, match="at least 2"):
        grid_table(s, (1, 3, 3), sources=sources)
    with pytest.raises(ValueError, match="the mask has shape"):
        grid_table(s, (3, 3, 3), compensable=np.ones((3, 3), dtype=bool), sources=sources)
    for unit in (0.0, -1e-4, float("nan")):
        with pytest.raises(ValueError, match="controller's unit"):
            quantise_grid(grid_table(s, (3, 3, 3), sources=sources), unit)
    with pytest.raises(ValueError, match="outside the grid"):
        grid_table(s, (3, 3, 3), reference=(0, 0, 3), sources=sources)
