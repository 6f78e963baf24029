"""The planner: what a mounting tells, that plans stay inside machine and minutes, and that they beat the papers' fixed campaigns.

``ABBE_TEST_LONG=1`` compares with the papers, and lays tests out in 25 machines instead of 8.
"""

import os
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import scipy
from hypothesis import given, settings
from hypothesis import strategies as st

from abbe.models.geometry.bases import DIRECTIONS
from abbe.models.geometry.chain import all_chains
from abbe.models.machine import Machine
from abbe.models.paths import DIAGONALS
from abbe.models.planning.measurements import (
    DiagonalTest,
    HelixTest,
    Instruments,
    LineTest,
    SetupMinutes,
    candidates,
    expected_run,
    machine_seconds,
    opening,
)
from abbe.models.planning.plan import plan_campaign, uncertainty_mm
from abbe.models.planning.problem import factor, field_rows, mounting_information, problem, scale_temperature_mm2
from abbe.models.planning.search import extra_minutes
from abbe.models.solvers.observe import run_design, setup_unknowns
from abbe.models.solvers.priors import Priors
from abbe.models.uncertainty.inputs import StatedInputs
from tests.experiments.campaigns.planner_against_papers import compare, machines

MACHINE = Machine(
    "w-X-Y-b-Z-t",
    np.array([[0.0, 600.0], [0.0, 500.0], [0.0, 450.0]]),
    np.array([[300.0, 250.0, -150.0], [300.0, 250.0, -250.0], [0.0, 320.0, 260.0]]),
    np.array([0.0, 0.0, -120.0]),
)
TOOLS = Instruments()
FEW = replace(TOOLS, bar_lengths_mm=(100.0, 200.0))
"""Two bars instead of six: plans of the same kind, found sooner."""
LONG = os.environ.get("ABBE_TEST_LONG") == "1"


@settings(max_examples=25 if LONG else 8, deadline=None)
@given(st.tuples(*[st.floats(150.0, 3000.0)] * 3), st.integers(0, 2), st.sampled_from(all_chains()))
def test_every_candidate_stays_inside_the_strokes_and_above_its_cup(size, vertical, chain):
    m = Machine(chain, np.array([[-s / 3, s - s / 3] for s in size]))
    for test in candidates(m, TOOLS, vertical):
        run = expected_run(m, test, TOOLS, values=60)
        assert (run.axes_mm >= m.stroke_mm[:, 0] + 4.9).all()
        assert (run.axes_mm <= m.stroke_mm[:, 1] - 4.9).all()
        if isinstance(test, HelixTest):  # no tool is stated
            assert (run.axes_mm[:, vertical] >= test.centre_mm[vertical] - 1e-9).all()
            assert np.allclose(np.linalg.norm(run.axes_mm - test.centre_mm, axis=1), test.radius_mm, rtol=1e-6, atol=0.0)


def test_the_information_of_separate_mountings_adds_up_to_the_posterior_of_the_joint_problem():
    """Marginalising mounting by mounting is exact: the same posterior as all unknowns together."""
    what = problem(MACHINE, TOOLS, 3)
    tests = (LineTest(0, (0.1, 0.9)), DiagonalTest("npp", "XYZ"), DiagonalTest("npp", "ZYX"))
    added = np.eye(what.size) + mounting_information(what, tests[:1]) + mounting_information(what, tests[1:])
    runs = [expected_run(MACHINE, t, TOOLS) for t in tests]
    runs[2] = replace(runs[2], t_s=runs[2].t_s + 500.0)
    setup = setup_unknowns(tuple(runs), Priors())
    a = np.concatenate([run_design(MACHINE, what.terms, r, setup) for r in runs]) / np.hypot(0.3e-3, 0.3e-3)
    n = len(what.terms)
    shared = n + len(DIRECTIONS)
    root = scipy.linalg.block_diag(what.root[:shared, :shared], np.diag(setup.prior_sd))
    whole = np.linalg.inv((a @ root).T @ (a @ root) + np.eye(len(root)))[:n, :n]
    assert np.linalg.inv(added)[:n, :n] == pytest.approx(whole, abs=1e-9)


def test_a_factor_reproduces_the_information():
    what = problem(MACHINE, TOOLS, 4)
    information = mounting_information(what, (HelixTest((300.0, 250.0, 50.0), 150.0),))
    f = factor(information)
    assert f.T @ f == pytest.approx(information, abs=2e-5)


def test_more_tests_never_tell_less():
    what = problem(MACHINE, TOOLS, 4)
    rows = field_rows(what, 0.8, 4)
    cup = (300.0, 250.0, 50.0)
    tests = (HelixTest(cup, 150.0), HelixTest(cup, 100.0), HelixTest(cup, 100.0, -1))
    found = [uncertainty_mm(np.eye(what.size) + mounting_information(what, tests[:k]), rows) for k in (1, 2, 3)]
    assert found[0] > found[1] > found[2]


def test_set_ups_that_are_shared_cost_less():
    minutes, cup = SetupMinutes(), HelixTest((300.0, 250.0, 50.0), 150.0)
    assert extra_minutes(minutes, 2.0, cup, ()) == 5.0
    assert extra_minutes(minutes, 2.0, replace(cup, radius_mm=100.0), (cup,)) == 3.5
    assert extra_minutes(minutes, 2.0, replace(cup, direction=-1), (cup,)) == 2.0
    first = DiagonalTest("ppp", "XYZ")
    assert extra_minutes(minutes, 1.0, first, ()) == 9.0
    assert extra_minutes(minutes, 1.0, DiagonalTest("ppp", "ZYX"), (first,)) == 1.0
    assert extra_minutes(minutes, 1.0, LineTest(0, (0.1, 0.1)), ()) == 6.0


@pytest.fixture(scope="module")
def plan():
    return plan_campaign(MACHINE, minutes=12.0, tools=FEW)


def test_a_plan_keeps_its_minutes_and_every_step_buys_something(plan):
    assert plan.minutes <= 12.0
    u = [plan.u_before_mm[0], *(s.u_worst_mm for s in plan.steps)]
    assert all(a >= b for a, b in pairwise(u))
    assert u[-1] < 0.3 * u[0]
    assert [s.until_min for s in plan.steps] == pytest.approx(np.cumsum([s.minutes for s in plan.steps]))
    assert len({s.label for s in plan.steps}) == len(plan.steps) == len(plan.runs)
    assert any("tool (0, 0, -120) mm" in text for text in plan.open_questions)
    assert any("would be seen with" in text for text in plan.open_questions)
    assert any("would raise the rank" in text for text in plan.open_questions)


def test_the_same_question_has_the_same_answer(plan):
    assert plan_campaign(MACHINE, minutes=12.0, tools=FEW).steps == plan.steps


def test_a_goal_is_reached_with_fewer_minutes_or_said_to_be_out_of_reach():
    easy = plan_campaign(MACHINE, minutes=60.0, goal_mm=25e-3, tools=FEW)
    assert easy.goal.reached
    assert 2 * easy.u_worst_mm <= 25e-3
    assert easy.minutes < 25.0
    # it ends with the step that reaches it
    assert [2 * s.u_worst_mm <= 25e-3 for s in easy.steps] == [False] * (len(easy.steps) - 1) + [True]
    assert easy.goal.minutes_needed == easy.minutes == easy.steps[-1].until_min
    hopeless = plan_campaign(MACHINE, minutes=5.0, goal_mm=1e-5, tools=FEW)
    assert not hopeless.goal.reached
    assert hopeless.goal.minutes_needed is None
    assert hopeless.goal.limit_mm > 1e-5
    assert "temperature of the machine's scales" in hopeless.goal.limit_by
    cold = replace(FEW, inputs=StatedInputs().without_stated_inputs())
    perfect = plan_campaign(MACHINE, minutes=5.0, goal_mm=1e-5, tools=cold)
    assert "calibration" in perfect.goal.limit_by
    assert perfect.goal.limit_mm < hopeless.goal.limit_mm


def test_scales_of_unknown_temperature_count_as_in_the_budget_of_a_solution():
    """Three scales, each 11.5e-6/K times 0.2 K: at the nodes of the inner volume, rigid motion out, computed here by hand."""
    what = problem(MACHINE, TOOLS, 4)
    rows = field_rows(what, 0.8, 5)
    half = 0.8 * MACHINE.length_mm / 2
    node = np.linspace(-1.0, 1.0, 5)[:, None] * half * 11.5e-6 * 0.2  # a scale is not a rigid motion but for its mean
    x, y, z = np.meshgrid(*node.T, indexing="ij")
    found = scale_temperature_mm2(what, rows)
    corner = np.sqrt(x**2 + y**2 + z**2).max()
    assert np.sqrt(found.max()) == pytest.approx(corner, rel=0.25)
    assert uncertainty_mm(np.eye(what.size), rows, found)[0] > uncertainty_mm(np.eye(what.size), rows)[0]


@pytest.mark.parametrize(
    ("tool", "vertical", "opens"),
    [((0, 0, -120), 2, "+Z"), ((0, 0, -120), 1, "+Z"), ((0, 150, 0), 2, "-Y"), ((-90, 0, 5), 2, "+X"), ((0, 0, 0), 1, "+Y")],
)
def test_hemispheres_open_towards_the_spindle(tool, vertical, opens):
    """Vertical axis Y and a spindle along Z: a hemisphere that opened along Y would bring the spindle down beside the cup."""
    m = replace(MACHINE, tool_mm=np.array(tool, dtype=float))
    towards = opening(m, vertical)
    assert towards.text == opens
    assert bool(towards.warning) == (not any(tool))
    for test in candidates(m, TOOLS, vertical):
        if isinstance(test, HelixTest):
            run = expected_run(m, test, TOOLS, values=40)
            beyond = (run.axes_mm - test.centre_mm)[:, towards.axis] * towards.side
            assert beyond.min() >= -1e-9
            assert (run.axes_mm >= m.stroke_mm[:, 0]).all()
            assert (run.axes_mm <= m.stroke_mm[:, 1]).all()


def test_a_plan_says_when_nobody_knows_where_the_spindle_is(plan):
    bare = replace(MACHINE, tool_mm=np.zeros(3))
    assert "tool_mm" in plan_campaign(bare, minutes=5.0, tools=FEW).warnings[0]
    assert plan.warnings == ()
    assert "oblique" in opening(replace(MACHINE, tool_mm=np.array([80.0, 0.0, -100.0]))).warning


def test_a_slow_machine_takes_longer():
    cup = HelixTest((300.0, 250.0, 50.0), 150.0)
    slow = replace(TOOLS, max_feed_mm_min=1000.0)
    assert machine_seconds(MACHINE, cup, slow) > 1.9 * machine_seconds(MACHINE, cup, TOOLS)
    assert expected_run(MACHINE, cup, slow).t_s[-1] == pytest.approx(2.0 * expected_run(MACHINE, cup, TOOLS).t_s[-1])


@pytest.mark.parametrize("tools", [Instruments(bar_lengths_mm=()), replace(FEW, laser=False)])
def test_a_plan_uses_only_what_there_is(tools):
    kinds = {isinstance(t, HelixTest) for t in plan_campaign(MACHINE, minutes=12.0, tools=tools).recipes}
    assert kinds == {bool(tools.bar_lengths_mm)}


def test_what_cannot_be_planned_is_refused():
    with pytest.raises(ValueError, match="fits into 1 minutes"):
        plan_campaign(MACHINE, minutes=1.0)
    with pytest.raises(ValueError, match="positive"):
        plan_campaign(MACHINE, minutes=-5.0)
    with pytest.raises(ValueError, match="fits into the strokes"):
        candidates(Machine("w-X-Y-b-Z-t", np.array([[0.0, 30.0]] * 3)), TOOLS)
    with pytest.raises(ValueError, match="neither"):
        Instruments(bar_lengths_mm=(), laser=False)


PAPERS = [(3, "both"), (1, "4 step diagonals"), (3, "5 origins x 2 radii"), (0, "5 origins x 2 radii")]


@pytest.mark.skipif(not LONG, reason="compares whole plans: ABBE_TEST_LONG=1 does")
@pytest.mark.parametrize(("number", "name"), PAPERS)
def test_the_plan_is_at_least_twice_as_good_as_a_papers_campaign_of_the_same_minutes(number, name):
    assert compare(machines(4)[number], name).factor >= 2.0


def test_in_the_time_of_one_helix_nothing_is_twice_as_good_and_the_plan_is_near_the_best():
    """Physics: one mounting cannot see a volume. The planner stays within 1.2 times the best mounting there is."""
    found = compare(machines(1)[0], "one helix")
    assert found.paper_um / found.best_um < 2.0
    assert found.planner_um <= 1.2 * found.best_um


def test_all_diagonals_are_candidates():
    assert {t.diagonal for t in candidates(MACHINE, TOOLS) if isinstance(t, DiagonalTest)} == set(DIAGONALS)
