"""Sequences: geometry, dry run, and refusal before anything moves."""

import math
import os
from itertools import groupby, pairwise

import numpy as np
import pytest

from abbe.models.machine import Machine
from abbe.models.paths import DIAGONALS, diagonal_ends, step_diagonal
from abbe.service.domain.run import parsed_setup
from abbe.service.errors import StrokeError
from abbe.service.sequences.check import dry_run, dry_run_campaign, positions
from abbe.service.sequences.recipes.campaigns import identification, quick_check, verification
from abbe.service.sequences.recipes.recipe import Diagonal, Helix, Linear
from abbe.service.sequences.steps import (
    MAX_PATH_POINTS,
    CampaignPlan,
    MountBar,
    MountLaser,
    MoveTo,
    ReadLaser,
    RecordPath,
    TestPlan,
    Unmount,
    ZeroLaser,
)
from tests.run_documents import BAR

LONG = os.environ.get("ABBE_TEST_LONG") == "1"
MACHINE = Machine("w-X-Y-b-Z-t", np.array([[0.0, 600.0], [0.0, 500.0], [0.0, 450.0]]))


def test_a_helix_stays_on_its_sphere_from_pole_to_equator_and_back():
    out = Helix("h", "A", "identify", (300.0, 250.0, 100.0), 150.0, direction=1).plan(MACHINE)
    path = next(s for s in out.steps if isinstance(s, RecordPath)).points_mm
    radii = [math.dist(p, (300.0, 250.0, 100.0)) for p in path]
    assert max(abs(r - 150.0) for r in radii) < 1e-4  # the controller's 10 nm grid
    assert path[0] == (300.0, 250.0, 250.0)
    assert path[-1][2] == pytest.approx(100.0, abs=1e-5)
    back = Helix("h", "A", "identify", (300.0, 250.0, 100.0), 150.0, direction=-1).plan(MACHINE)
    assert next(s for s in back.steps if isinstance(s, RecordPath)).points_mm == path[::-1]


def test_the_area_law_spreads_points_evenly_over_the_hemisphere():
    plan = Helix("h", "A", "identify", (300.0, 250.0, 100.0), 150.0, law="area").plan(MACHINE)
    z = np.array(next(s for s in plan.steps if isinstance(s, RecordPath)).points_mm)[:, 2]
    assert np.ptp(np.diff(z)) < 1e-4


@pytest.mark.parametrize("order", ["XYZ", "ZYX", "YXZ"])
@pytest.mark.parametrize("diagonal", list(DIAGONALS))
def test_step_diagonals_move_one_axis_at_a_time_and_return_the_way_they_came(diagonal, order):
    start, end = diagonal_ends(MACHINE.stroke_mm, diagonal)
    p = step_diagonal(start, end, 4, order)
    assert len(p) == 2 * (3 * 4 + 1)
    moved = np.abs(np.diff(p[:13], axis=0)) > 1e-9
    assert (moved.sum(axis=1) == 1).all()
    assert "".join("XYZ"[int(np.argmax(m))] for m in moved[:3]) == order
    assert p[12] == pytest.approx(end)
    assert (p[13:] == p[:13][::-1]).all()


def test_laser_lines_approach_their_start_in_the_direction_of_the_first_motion():
    for recipe in (Diagonal("d", "D", "identify", "npp"), Linear("l", "L", "identify", 0, at_share=(0.15, 0.15))):
        plan = recipe.plan(MACHINE)
        approach, start = (s.target_mm for s in plan.steps[:2] if isinstance(s, MoveTo))
        end = plan.setup.end_mm
        for a in range(3):
            if end[a] != start[a]:
                assert np.sign(start[a] - approach[a]) == np.sign(end[a] - start[a])
        assert sum(isinstance(s, ZeroLaser) for s in plan.steps) == 1


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("direction", [1, -1])
def test_a_helix_too_approaches_its_start_in_the_direction_of_the_first_motion(direction, axis):
    plan = Helix("h", "A", "identify", (300.0, 250.0, 200.0), 150.0, direction=direction, axis=axis).plan(MACHINE)
    *_, approach, start = (s.target_mm for s in plan.steps if isinstance(s, MoveTo))
    path = np.array(next(s for s in plan.steps if isinstance(s, RecordPath)).points_mm)
    assert start == tuple(path[0])
    for a in range(3):
        first = next(np.sign(d) for d in np.diff(path[:, a]) if d)
        assert np.sign(start[a] - approach[a]) == first
    assert abs(math.dist(approach, (300.0, 250.0, 200.0)) - 150.0) < 0.7  # the bar hangs in it already: its stroke is 1 mm


def test_an_approach_ends_at_the_stroke():
    plan = Helix("h", "A", "identify", (300.0, 250.0, 300.0), 149.9).plan(MACHINE)
    assert [s.target_mm for s in plan.steps if isinstance(s, MoveTo)][2] == (299.5, 249.5, 450.0)
    dry_run(MACHINE, plan)


def test_whatever_is_mounted_is_taken_away_before_the_next_test():
    for campaign in (identification(MACHINE), verification(MACHINE), quick_check(MACHINE)):
        for _, tests in groupby(campaign.tests, key=lambda t: t.setup_id):
            steps = [s for t in tests for s in t.steps]
            assert sum(isinstance(s, MountBar | MountLaser) for s in steps) == 1
            assert isinstance(steps[-1], Unmount)
            assert sum(isinstance(s, Unmount) for s in steps) == 1


def test_the_identification_holds_runs_that_only_judge_in_mountings_of_fitted_runs():
    tests = identification(MACHINE).tests
    judges = [t for t in tests if t.role == "holdout"]
    assert [t.label for t in judges] == ["judge-helix1", "judge-step-ppn-ZYX"]
    assert all(any(t.setup_id == j.setup_id and t.role == "identify" for t in tests) for j in judges)
    assert sum(d.duration_s for d in dry_run_campaign(MACHINE, CampaignPlan("judges", tuple(judges)), 6000.0)) < 240.0


def test_two_helices_in_one_set_up_mount_once_and_clear_away_once():
    out = Helix("out", "A", "identify", (300.0, 250.0, 100.0), 150.0, unmount=False).plan(MACHINE)
    back = Helix("back", "A", "identify", (300.0, 250.0, 100.0), 150.0, direction=-1, mount=False).plan(MACHINE)
    kinds = [type(s) for s in out.steps + back.steps]
    assert kinds == [MoveTo, MountBar, MoveTo, MoveTo, MoveTo, RecordPath, MoveTo, MoveTo, RecordPath, Unmount]


CHAINS = ["w-X-Y-b-Z-t", "w-b-X-Y-Z-t", "w-Z-b-X-Y-t"]
STROKES = [(600, 500, 450), (812.8, 495, 508), (250, 300, 200), (1500, 1200, 800), (3000, 2000, 1000)]
# Every stroke with one chain in turn; ABBE_TEST_LONG=1 plays all pairs.
MACHINES = [(chain, stroke) for k, stroke in enumerate(STROKES) for chain in (CHAINS if LONG else [CHAINS[k % 3]])]


@pytest.mark.parametrize(("chain", "stroke"), MACHINES)
def test_shipped_campaigns_fit_into_any_machine(chain, stroke):
    m = Machine(chain, np.array([[-100.0, s - 100.0] for s in stroke]))
    for plan in (identification(m), verification(m), quick_check(m)):
        for d in dry_run_campaign(m, plan, 6000.0):
            assert d.duration_s > 0
            assert d.readings > 10
        assert len({t.label for t in plan.tests}) == len(plan.tests)


def test_verification_shares_no_centre_radius_or_path_with_the_identification():
    used = [t.bar for t in identification(MACHINE).tests if t.test == "ballbar_helix"]
    check = next(t.bar for t in verification(MACHINE).tests if t.test == "ballbar_helix")
    assert all((u.centre_mm != check.centre_mm).any() and u.radius_mm != check.radius_mm for u in used)
    assert not [t for t in identification(MACHINE).tests if t.test == "laser_diagonal" and not t.setup.order]


def test_a_stroke_exceeded_names_axis_amount_and_remedy_before_anything_moves():
    plan = Helix("h7", "A", "identify", (550.0, 250.0, 100.0), 150.0).plan(MACHINE)
    with pytest.raises(StrokeError, match=r"test h7: X would go to .* mm beyond its stroke 0..600") as caught:
        dry_run(MACHINE, plan)
    assert "nothing has moved" in caught.value.remedy


def test_a_feed_over_the_limit_is_refused():
    with pytest.raises(StrokeError, match="6000 mm/min, the limit is 3000"):
        dry_run_campaign(MACHINE, verification(MACHINE), 3000.0)


def test_dry_run_times_a_path_and_counts_its_readings():
    plan = Helix("h", "A", "identify", (300.0, 250.0, 100.0), 150.0, turns=3, feed_mm_min=1500.0, rate_hz=50, mount=False).plan(MACHINE)
    run = dry_run(MACHINE, plan)
    path = list(positions(plan.steps))  # the approach included
    length = sum(math.dist(a, b) for a, b in pairwise(path))
    assert run.path_mm == pytest.approx(length)
    assert run.duration_s == pytest.approx(length / 1500 * 60)
    recorded = next(s for s in plan.steps if isinstance(s, RecordPath)).points_mm
    assert run.readings == int(sum(math.dist(a, b) for a, b in pairwise(recorded)) / 1500 * 60 * 50)
    assert sum(isinstance(s, ReadLaser) for s in plan.steps) == 0


def test_a_long_helix_gets_longer_chords_and_fits_into_the_controllers_path_memory():
    big = Machine("w-X-Y-b-Z-t", np.array([[0.0, 3000.0], [0.0, 2000.0], [0.0, 1000.0]]))
    plan = Helix("h", "A", "identify", (1500.0, 1000.0, 200.0), 750.0).plan(big)
    path = np.array(next(s for s in plan.steps if isinstance(s, RecordPath)).points_mm)
    assert len(path) == MAX_PATH_POINTS
    middles = np.linalg.norm((path[1:] + path[:-1]) / 2 - np.array([1500.0, 1000.0, 200.0]), axis=1)
    assert 750.0 - middles.min() < 0.025  # beside the pole, where the area law strides farthest
    assert 750.0 - middles[200:].min() < 2e-3
    dry_run(big, plan)


def test_a_path_the_controller_cannot_hold_is_refused_before_anything_moves():
    points = tuple((x, 0.0, 0.0) for x in np.linspace(0.0, 600.0, MAX_PATH_POINTS + 1))
    with pytest.raises(StrokeError, match="test long: the path has 8193 points, the controller holds 8192"):
        dry_run(
            MACHINE,
            TestPlan("long", "ballbar_helix", "identify", parsed_setup("ballbar_helix", BAR), (RecordPath(points, 2000.0, 100, 1),)),
        )


def test_a_discovery_campaign_s_helices_stay_within_a_quarter_of_a_micrometre_of_their_sphere():
    from abbe.service.sequences.recipes.campaigns import BACK, discovery_campaign, new_measurement

    for plan in discovery_campaign(MACHINE).tests:
        for step in plan.steps:
            if isinstance(step, RecordPath):
                chord = np.linalg.norm(np.diff(np.array(step.points_mm), axis=0), axis=1).max()
                assert chord**2 / (8.0 * plan.bar.radius_mm) < 2.5e-4, plan.label
    there, back = new_measurement(MACHINE).tests[:2]
    assert (back.label, there.setup, back.mounts) == (BACK, back.setup, False)
    assert not any(isinstance(step, Unmount) for step in there.steps)
