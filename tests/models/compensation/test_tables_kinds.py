"""Tables for controllers that take less than a grid: nothing counted twice, the order of compensation, single motions, what each leaves."""

import os
from dataclasses import replace

import numpy as np
import pytest

from abbe.models.compensation.achievable import (
    achievable,
    cross_only,
    enough_for_the_field,
    individually_observable,
    motion_tables,
    positioning_only,
    squareness_tables,
)
from abbe.models.compensation.additive import SQUARENESS_SLOPES, mean_linear
from abbe.models.compensation.distances import correction_error_mm, figures, inner_box_mm, predict_distances, random_pairs
from abbe.models.compensation.nine_tables import nine_tables, table_design
from abbe.models.compensation.tables import NineTables, grid_positions, quantise
from abbe.models.solvers.assessment import observability_of
from abbe.models.solvers.joint import solve_joint
from abbe.models.uncertainty.inputs import StatedInputs
from abbe.models.uncertainty.sources import error_sources
from tests.experiments.mathematics.stages import Stage, applied, at_corrected_position, of_corrected_position, second_order_mm
from tests.models.solvers.truth import FLOOR, MACHINE, SIGMA, Truth

COUNTS = (25, 21, 19)
LONG = os.environ.get("ABBE_TEST_LONG") == "1"
PAIRS = random_pairs(inner_box_mm(MACHINE), 2000, seed=6)
POINTS = np.random.default_rng(4).uniform(MACHINE.stroke_mm[:, 0] + 5, MACHINE.stroke_mm[:, 1] - 5, (3000, 3))


@pytest.fixture(scope="module")
def solved():
    truth = Truth(2)
    return truth, solve_joint(MACHINE, truth.campaign(), order=6, sigma_mm=SIGMA, floor_mm=FLOOR)


@pytest.fixture(scope="module")
def nine(solved):
    return nine_tables(solved[1], COUNTS)


def only(solution, **coefficients):
    """The solution with these coefficients and no others."""
    theta = np.zeros_like(solution.estimate.theta)
    for name, value in coefficients.items():
        theta[solution.estimate.names.index(name.replace("_", "."))] = value
    return replace(solution, estimate=replace(solution.estimate, theta=theta))


def test_positioning_and_cross_tables_together_are_the_nine_and_hold_nothing_twice(nine):
    own, cross = positioning_only(nine), cross_only(nine)
    assert own.correction_at(POINTS) + cross.correction_at(POINTS) == pytest.approx(nine.correction_at(POINTS), abs=1e-15)
    for a in range(3):
        assert not (own.correction_mm[a] * cross.correction_mm[a]).any()
        assert not cross.correction_mm[a][:, a].any()
        assert not cross.u_mm[a][:, a].any()


def test_a_scale_that_stands_in_two_tables_would_be_corrected_twice(solved):
    _, s = solved
    machine = only(s, EXX_1=30e-3)  # 60 um over the stroke
    tables = nine_tables(machine, COUNTS)
    left = predict_distances(machine, lambda p: positioning_only(tables).correction_at(p) + cross_only(tables).correction_at(p))
    twice = predict_distances(machine, lambda p: positioning_only(tables).correction_at(p) + tables.correction_at(p))
    assert left.known_mm < 1e-6
    assert twice.known_mm == pytest.approx(predict_distances(machine).known_mm, rel=1e-3)


def test_squareness_as_a_parameter_has_the_sign_of_the_conventions_and_leaves_the_tables_straight(solved):
    _, s = solved
    for k, (name, axis, out, sign) in enumerate((("C0Y", 1, 0, 1.0), ("B0Z", 2, 0, -1.0), ("A0Z", 2, 1, 1.0))):
        found = squareness_tables(only(s, **{name: 40e-6}), COUNTS)
        assert [p.value for p in found.parameters] == pytest.approx([40e-6 * (j == k) for j in range(3)], abs=1e-12)
        assert all(np.abs(c).max() < 1e-9 for c in found.tables.correction_mm)
        want = np.zeros_like(POINTS)
        want[:, out] = sign * 40e-6 * (POINTS[:, axis] - MACHINE.stroke_mm[axis, 0])
        assert found.squareness_at(POINTS) == pytest.approx(want, abs=1e-12)


def test_parameters_and_their_tables_correct_the_same_distances_as_the_nine(solved, nine):
    _, s = solved
    found = squareness_tables(s, COUNTS)
    assert correction_error_mm(found.correction_at, PAIRS) == pytest.approx(correction_error_mm(nine.correction_at, PAIRS), abs=1e-9)
    for a in range(3):
        travel = found.tables.position_mm[a] - found.tables.position_mm[a].mean()
        assert np.abs(np.delete(travel @ found.tables.correction_mm[a], a)).max() < 1e-9
        assert (found.tables.u_mm[a][1:] > 0).all()


def test_squareness_parameters_carry_the_uncertainty_of_the_very_slopes_they_are(solved):
    """Slopes of the tables, for draws of the machine from its covariance: their scatter is u, and they are not the mean over the volume."""
    _, s = solved
    data = error_sources(s, StatedInputs().without_stated_inputs())
    counts = (9, 8, 7)
    found = squareness_tables(s, counts, sources=data).parameters
    root = np.linalg.cholesky(s.term_covariance + 1e-32 * np.eye(len(s.terms)))
    drawn = root @ np.random.default_rng(5).standard_normal((len(root), 1000))
    grids = grid_positions(MACHINE, counts)
    entries = [-effect @ drawn for effect in table_design(s, grids, 9)]  # tables of all drawn machines, shape (positions, 3, draws)
    one = nine_tables(s, counts, sources=replace(data, coefficients=drawn[:, 0]))
    for mine, tables in zip(one.correction_mm, entries, strict=True):
        assert mine == pytest.approx(tables[:, :, 0], abs=1e-12)
    slope = [np.polyfit(p, t.reshape(p.size, -1), 1)[0].reshape(3, -1) for p, t in zip(grids, entries, strict=True)]
    slopes = [-sign * (slope[a][b] + slope[b][a]) for _, a, b, sign in SQUARENESS_SLOPES]
    assert [p.u for p in found] == pytest.approx(np.std(slopes, axis=1), rel=0.1)  # 1000 draws know it to 2 %
    mean = [p.value for p in mean_linear(s)[3:]]
    assert max(abs(p.value - m) / p.u for p, m in zip(found, mean, strict=True)) > 3.0


def test_cross_tables_made_for_the_corrected_position_give_the_nine_again(nine):
    stages = (Stage(positioning_only(nine).correction_at), Stage(cross_only(at_corrected_position(nine)).correction_at, "corrected"))
    plain = (stages[0], Stage(cross_only(nine).correction_at, "corrected"))
    assert np.abs(applied(stages, POINTS) - nine.correction_at(POINTS)).max() < 3e-6
    assert second_order_mm(plain, POINTS) < 2e-5  # smooth tables: the order hardly matters ...


def test_the_order_matters_for_steep_tables_and_its_size_is_stated():
    grid = tuple(np.linspace(lo, hi, 1201) for lo, hi in MACHINE.stroke_mm)
    columns = [np.zeros((1201, 3)) for _ in range(3)]
    columns[0][:, 0] = 0.1 * (grid[0] - grid[0][0]) / 600.0  # 0.1 mm of scale
    columns[0][:, 1] = 5e-3 * np.sin(2 * np.pi * grid[0] / 20.0)  # a straightness of the screw's pitch
    tables = NineTables(grid, tuple(columns), tuple(np.zeros_like(c) for c in columns))
    naive = (Stage(positioning_only(tables).correction_at), Stage(cross_only(tables).correction_at, "corrected"))
    made = (naive[0], Stage(cross_only(at_corrected_position(tables)).correction_at, "corrected"))
    size = second_order_mm(naive, POINTS)
    assert 0.5e-4 < size < 2e-4  # slope 5 um x 2 pi / 20 mm times 0.1 mm = 0.16 um
    left = np.abs(applied(made, POINTS) - tables.correction_at(POINTS))
    assert left.max() < 0.3 * size


def test_a_correction_as_a_function_of_the_corrected_position_takes_the_error_where_the_axes_stand(solved):
    truth, _ = solved
    correction = of_corrected_position(lambda p: -truth.deviation(p))
    assert np.abs(truth.deviation(POINTS + correction(POINTS)) + correction(POINTS)).max() < 1e-12
    at_command = -truth.deviation(POINTS)
    assert 1e-7 < np.abs(truth.deviation(POINTS + at_command) + at_command).max() < 2e-5  # what one neglects: under 0.02 um


def test_all_motions_in_tables_are_the_deviation(solved):
    _, s = solved
    tables = motion_tables(s, (201, 201, 201), {t.motion for t in s.terms}, any_tool=False)
    assert tables.left_out == ()
    assert tables.correction_at(POINTS) == pytest.approx(-s.deviation_mm(POINTS), abs=1e-5)
    longer = MACHINE.tool_mm + np.array([5.0, 0.0, -80.0])
    assert tables.correction_at(POINTS, longer) == pytest.approx(-s.deviation_mm(POINTS, longer), abs=1e-5)


def test_only_motions_that_are_told_apart_are_written_under_their_names(solved):
    _, s = solved
    seen = individually_observable(s)
    told = {m.name: m.status for m in observability_of(s).motions}
    hidden = {name.split(".")[0] for c in s.identifiability.hidden for name, _ in c.weights}
    tables = motion_tables(s, COUNTS, seen)
    assert hidden
    assert not hidden & (set(tables.motions) | set(tables.squareness_rad))
    assert set(tables.left_out) == {name for name, status in told.items() if status != "observed"}
    assert individually_observable(s, weak=True) == {name for name, status in told.items() if status != "not observable"}
    for name, values in tables.motions.items():
        mine = {n: s.estimate.value(n) for n in s.estimate.names if n.split(".")[0] == name}
        alone = only(s, **{n.replace(".", "_"): v for n, v in mine.items()})
        assert values == pytest.approx(motion_tables(alone, COUNTS, {name}).motions[name], abs=1e-12)


def test_as_few_motions_as_carry_the_field_are_right_for_this_tool_and_only_for_it(solved):
    truth, s = solved
    enough = enough_for_the_field(s)
    tables = motion_tables(s, (61, 61, 61), enough, any_tool=False)
    assert not tables.any_tool
    assert {"EAZ", "EBZ", "ECZ"} <= set(tables.left_out)  # nothing nearer the tool: this carriage's angles look like translations
    assert predict_distances(s, tables.correction_at, pairs=PAIRS).known_mm < 0.1e-3

    def left(tool):
        off = [truth.deviation(p, None, tool) + tables.correction_at(p, tool) for p in (PAIRS.first_mm, PAIRS.second_mm)]
        return figures(PAIRS.error_mm(*off)).rms_mm

    assert left(MACHINE.tool_mm + np.array([0.0, 0.0, -150.0])) > 2 * left(MACHINE.tool_mm)


def test_hidden_and_weak_motions_are_not_written_as_right_for_any_tool(solved):
    _, s = solved
    seen = individually_observable(s)
    hidden = sorted({name.split(".")[0] for c in s.identifiability.hidden for name, _ in c.weights})
    assert hidden
    for name in hidden:
        with pytest.raises(ValueError, match=f"the readings do not separate {name} from other motions"):
            motion_tables(s, COUNTS, {name} | seen)
    tables = motion_tables(s, COUNTS)  # the default: what is observable
    assert set(tables.motions) | set(tables.squareness_rad) == seen
    assert set(tables.left_out) == {t.motion for t in s.terms} - seen
    assert not motion_tables(s, COUNTS, {hidden[0]}, any_tool=False).any_tool


def test_motions_that_do_not_exist_are_refused(solved):
    with pytest.raises(ValueError, match="EXQ cannot be written"):
        motion_tables(solved[1], COUNTS, {"EXX", "EXQ"})
    with pytest.raises(ValueError, match="no motion cannot be written"):
        motion_tables(solved[1], COUNTS, set())


def test_every_kind_states_what_it_leaves_and_more_table_leaves_less(solved):
    _, s = solved
    rows = {r.kind: r for r in achievable(s, counts=COUNTS, grid_nodes=(5, 9, 13), lsb_mm=1e-4)}
    chain = ("no table", "positioning tables", "positioning tables and squareness", "nine tables", "grid 9 x 9 x 9", "grid 13 x 13 x 13")
    left = [rows[k].distances.rms_mm for k in chain]
    assert left == sorted(left, reverse=True)
    assert all(r.distances.u_rms_mm > 0 for r in rows.values())
    assert len({r.distances.unknown_mm for r in rows.values()}) == 1  # no table takes out what nobody knows
    # the mean of an rms is no smaller than sqrt(2 / pi) of the root of its mean square: all of it in one input
    assert all(r.distances.rms_mm >= r.distances.unknown_mm * 0.75 for r in rows.values())
    grid = rows["grid 9 x 9 x 9"]
    assert grid.entries == 3 * 9**3
    assert grid.rounding_mm == pytest.approx(np.sqrt(2) * 1e-4 / np.sqrt(12.0) * (2.0 / 3.0) ** 1.5, rel=0.2)
    one_tool = rows["tables of single motions, right for this tool only"]
    alone = rows["tables of the motions that are observable by themselves"]
    assert one_tool.distances.rms_mm < rows["nine tables"].distances.rms_mm < alone.distances.rms_mm


def test_no_other_positioning_tables_are_much_better(solved):
    _, s = solved
    stated = predict_distances(s, positioning_only(nine_tables(s, COUNTS)).correction_at, pairs=PAIRS).known_mm
    # the best there are for these very pairs, by least squares over the entries of the three tables
    columns = []
    for a in range(3):
        grid = np.linspace(*MACHINE.stroke_mm[a], 13)
        for k in range(1, 13):
            hat = [np.interp(p[:, a], grid, np.eye(13)[k]) for p in (PAIRS.first_mm, PAIRS.second_mm)]
            columns.append(PAIRS.unit[:, a] * (hat[1] - hat[0]))
    a = np.array(columns).T
    error = PAIRS.error_mm(s.deviation_mm(PAIRS.first_mm), s.deviation_mm(PAIRS.second_mm))
    best = np.sqrt(np.mean((error - a @ np.linalg.lstsq(a, error, rcond=None)[0]) ** 2))
    assert best <= stated < 1.2 * best


@pytest.mark.parametrize("unit", [0.0, -1e-4, float("nan"), float("inf")])
def test_a_unit_that_is_none_is_refused(nine, unit):
    with pytest.raises(ValueError, match="controller's unit"):
        quantise(nine, unit)
