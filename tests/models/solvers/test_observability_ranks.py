"""Honesty: the product reports, from runs, the ranks of math.md 4.6 and 5.5, and the null vectors listed there, in words."""

import json
from dataclasses import replace

import numpy as np
import pytest

from abbe.models.geometry.bases import smooth_terms
from abbe.models.solvers.assessment import observability
from abbe.models.solvers.observability.cures import CampaignLayout, count_observed, trials
from abbe.models.solvers.observability.rank import Knowledge, campaign_columns, compressed
from abbe.models.solvers.observe import setup_unknowns
from abbe.models.solvers.priors import Priors
from tests.models.solvers.observability_cases import (
    FXYZ,
    ONE,
    STEPS,
    TEN,
    WANG_EXPERIMENTS,
    YANG,
    YANG_EXPERIMENTS,
    squared_to_the_z_line,
    wang_diagonals,
)

DEGREES = (1, 2, 3, 4, 5)


@pytest.fixture(scope="module")
def yang(shared):
    table = json.loads((shared / "vectors" / "yang_ranks.json").read_text())["ranks"]
    return {key.split()[0]: [rank for rank, _ in rows] for key, rows in table.items()}


@pytest.fixture(scope="module")
def wang(shared):
    table = json.loads((shared / "vectors" / "wang_step_diagonal.json").read_text())["ranks"]
    return {key: [rank for rank, _ in rows] for key, rows in table.items()}


def test_every_experiment_that_is_made_of_runs_is_here(yang, wang):
    assert set(YANG_EXPERIMENTS) == set(yang) - {"e1", "e2", "e3"} | {"c3'"}
    assert set(WANG_EXPERIMENTS) == set(wang)


@pytest.mark.parametrize("key", [k for k in YANG_EXPERIMENTS if k not in ("d1", "c3'")])
def test_ranks_of_math_4_6(yang, key):
    assert [YANG_EXPERIMENTS[key].seen(d).rank for d in DEGREES] == yang[key]


def test_an_ideal_mirror_is_square_to_a_frame_and_the_rank_depends_on_which(yang):
    """In the paper's frame the table's ranks; in the product's own (X line the datum) one more from degree 4 on."""
    mirrors = YANG_EXPERIMENTS["d1"]
    assert [mirrors.seen(d, squared_to_the_z_line(d)).rank for d in DEGREES] == yang["d1"]
    assert [mirrors.seen(d).rank for d in DEGREES] == [11, 25, 38, 52, 63]


def test_helices_with_ideal_mirrors_reach_all_that_one_tool_can_show(yang):
    assert [YANG_EXPERIMENTS["c3'"].seen(d).rank for d in DEGREES] == yang["e1"]


@pytest.mark.parametrize("key", list(WANG_EXPERIMENTS))
def test_ranks_of_math_5_5(wang, key):
    assert [WANG_EXPERIMENTS[key].seen(d).rank for d in DEGREES] == wang[key]


@pytest.mark.parametrize("degree", [1, 3])
def test_lost_motion_as_an_unknown_costs_no_rank_where_cups_are_unknown_anyway(yang, degree):
    runs = YANG_EXPERIMENTS["a2"].runs
    assert observability(YANG, runs, terms=degree).rank == yang["a2"][degree - 1]


def test_what_no_run_with_the_same_tools_could_exceed_is_the_vector_map(yang):
    assert [observability(YANG, TEN, terms=d).reachable for d in (1, 2, 3, 5)] == [yang["e1"][d - 1] for d in (1, 2, 3, 5)]
    assert observability(FXYZ, wang_diagonals(("XYZ",)), terms=2).reachable == 25


# --- null vectors in words -------------------------------------------------------------------------------------------------------------


def texts(machine, runs, terms=1):
    return "\n".join(g.text for g in observability(machine, runs, terms=terms).hidden)


def test_null_vectors_of_every_single_tool_experiment():
    for runs in (ONE, TEN, STEPS, ONE + STEPS):
        said = texts(YANG, runs)
        assert "The slope of the yaw of Y (ECY) leaves no trace" in said  # ezy alone
        # eyy 1 goes with Sxy 0.303, eyx 1 with dxx -0.3: in our units over the stroke
        assert (
            "the squareness of X and Y (C0Y) cannot be distinguished with one tool length: 10 µrad of EBY over the stroke look like -3.03"
            in said
        )
        assert (
            "the slope of the pitch of X (EBX) cannot be distinguished with one tool length: 10 µm of EXX over the stroke look like 66.7"
            in said
        )


def test_null_vectors_of_one_helix():
    said = texts(YANG, ONE)
    assert "10 µrad of EAZ over the stroke look like -2.05 µrad of A0Z" in said  # exz 1, Syz 0.2047
    assert "The scale of X (EXX), the scale of Y (EYY) and the scale of Z (EZZ) cannot be distinguished" in said
    assert "no bar length here is calibrated" in said


def test_null_vectors_of_step_diagonals_with_unknown_tilt():
    said = texts(YANG, STEPS)
    assert "10 µm of EXX over the stroke look like 16.4 µm of EYY over the stroke" in said  # (-0.609, 1)
    assert "10 µm of EXX over the stroke look like 16 µm of EZZ over the stroke" in said  # (-0.625, 1)
    assert "an unknown tilt of the mirror" in said or "a tilted mirror reads like it" in said


def test_orders_that_are_hidden_alike_are_told_once():
    report = observability(YANG, TEN, terms=4)
    said = {g.motions: g for g in report.hidden}
    assert said[("ECY",)].count == 4
    assert said[("EXY", "EBY")].count == 3
    assert "The shape (orders 2 to 4) of the straightness of Y in X (EXY)" in said[("EXY", "EBY")].text
    assert sum(g.count for g in report.hidden) == len(report.terms) - report.rank


def test_harmless_combinations_move_nothing_and_harmful_ones_say_how_much():
    report = observability(YANG, TEN, terms=2)
    harmless = {g.motions for g in report.hidden if g.harmless}
    assert ("EXX", "EYY", "EZZ") not in harmless
    assert ("EBY", "C0Y") in harmless
    scale = next(g for g in report.hidden if g.motions == ("EXX", "EYY", "EZZ"))
    assert 10e-3 < scale.effect_mm < 60e-3
    by_name = dict(scale.weights)
    per_mm = [2 * by_name[f"E{a}{a}.1"] / length for a, length in zip("XYZ", YANG.length_mm, strict=True)]
    assert per_mm == pytest.approx([per_mm[0]] * 3, rel=1e-6)  # one common scale


def test_a_second_tool_length_and_a_laser_line_are_said_where_they_help():
    tools = observability(YANG, ONE + STEPS, terms=1)
    assert [a.cure for a in tools.advice] == ["a second tool length", "a tool whose end stands off to the side"]
    assert [a.rank for a in tools.advice] == [14, 15]  # the vector maps of math.md 4.6 with two and with three tools
    scales = observability(FXYZ, wang_diagonals(("XYZ",)), terms=1)
    group = next(g for g in scales.hidden if set(g.motions) == {"EXX", "EZZ"})
    assert "a laser line along X" in group.cures
    assert "a laser line along X or a laser line along Z" in group.text


def test_virtual_additions_give_the_ranks_that_the_tables_have_for_real_ones(wang):
    """A second step order lifts 36 to 38, and lines on two edges 38 to 39 (math.md 5.5, degree 3)."""
    one_order = WANG_EXPERIMENTS["8 tilt + linear laser X,Y,Z"]
    two_orders = WANG_EXPERIMENTS["two orders + linear X,Y,Z, 16 tilt"]
    assert gain(one_order, 3, "diagonals") == 38 - 36
    assert gain(two_orders, 3, "edges") == 39 - 38
    assert gain(WANG_EXPERIMENTS["8 tilt unknowns"], 3, "line X") == 32 - 31
    assert gain(YANG_EXPERIMENTS["b4"], 2, "bar") == 25 - 24


def gain(experiment, degree, key):
    terms, setup = smooth_terms(degree), setup_unknowns(experiment.runs, Priors())
    columns = compressed(campaign_columns(experiment.machine, terms, experiment.runs, setup))
    campaign = CampaignLayout(experiment.machine, terms, experiment.runs, columns, experiment.knowledge(terms, setup))
    found = trials(campaign, experiment.seen(degree))
    return next(count_observed(t.observed) for t in found if t.addition.key == key)


def test_a_bar_counts_as_calibrated_only_if_every_run_says_so():
    stated = [replace(r, u_length_mm=1e-3) for r in TEN]
    vague = [*stated[:-1], TEN[-1]]
    assert observability(YANG, tuple(stated), terms=1).rank == 11
    assert "bar_length_175" in observability(YANG, tuple(stated), terms=1).known
    assert observability(YANG, tuple(vague), terms=1).rank == 11  # the other bar carries the scale
    both = tuple(replace(r, u_length_mm=1e-3, length_calibrated=False) for r in TEN)
    assert observability(YANG, both, terms=1).rank == 10


def test_refusals():
    with pytest.raises(ValueError, match="no runs"):
        observability(YANG, ())
    with pytest.raises(ValueError, match="bar_length_7 is not a set-up unknown"):
        observability(YANG, ONE, terms=1, known=Knowledge({"bar_length_7": np.zeros(15)}))
