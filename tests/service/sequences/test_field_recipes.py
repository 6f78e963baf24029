"""Recipes of the field's tests: paths on their sphere, tangential feed-in, targets approached from the named side, within the strokes."""

import math
from itertools import pairwise

import numpy as np
import pytest

from abbe.models.geometry.chain import travel_sign
from abbe.models.machine import Machine
from abbe.models.paths import FACES, arc_through, circle_points, cycles_of, face_ends, target_shares, way_on_sphere
from abbe.service.errors import ConfigError
from abbe.service.sequences.check import dry_run, dry_run_campaign
from abbe.service.sequences.recipes.recipe import Circle, Diagonal, FaceDiagonal, Helix, HelixPoints, Linear
from abbe.service.sequences.recipes.recipe_file import shared_setups
from abbe.service.sequences.steps import CampaignPlan, MountBar, MoveTo, ReadBar, ReadLaser, RecordPath, Unmount

MACHINE = Machine("w-X-Y-b-Z-t", np.array([[0.0, 600.0], [0.0, 500.0], [0.0, 450.0]]))
CUP = (300.0, 250.0, 200.0)


def recorded(plan):
    return next(s for s in plan.steps if isinstance(s, RecordPath))


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("plane", ["XY", "YZ", "ZX"])
def test_a_circle_with_feed_in_and_out_of_half_a_turn(plane, direction):
    whole = Circle("c", "S", "identify", CUP, 150.0, plane, 0.0, 360.0, 180.0, 180.0, direction=direction, under_the_cup=True)
    plan = whole.plan(MACHINE)
    step = recorded(plan)
    path, (first, last) = np.array(step.points_mm), step.measured
    a, b = ("XYZ".index(c) for c in plane)
    assert np.abs(np.linalg.norm(path - CUP, axis=1) - 150.0).max() < 1e-4
    assert np.abs(path[:, 3 - a - b] - CUP[3 - a - b]).max() < 1e-9
    angle = np.unwrap(np.arctan2(path[:, b] - CUP[b], path[:, a] - CUP[a]))
    assert angle[last] - angle[first] == pytest.approx(direction * 2 * np.pi, abs=1e-6)
    assert angle[first] - angle[0] == pytest.approx(direction * np.pi, abs=1e-6)
    assert angle[-1] - angle[last] == pytest.approx(direction * np.pi, abs=1e-6)
    assert path[first] == pytest.approx(circle_points(np.array(CUP), 150.0, plane, np.zeros(1))[0], abs=1e-4)  # starts at 0 degrees
    assert plan.bar.plane == plane
    dry_run(MACHINE, plan)


@pytest.mark.parametrize("direction", [1, -1])
def test_a_partial_arc_stays_above_its_limits(direction):
    """220 degrees of the ZX plane about the pole, ISO 230-4's partial arc: from 110 degrees before to 110 after +Z."""
    cup = (300.0, 250.0, 100.0)
    arc = Circle("c", "S", "identify", cup, 120.0, "ZX", -110.0, 220.0, 2.0, 2.0, direction=direction)
    path, (first, last) = arc.path()
    assert min(p[2] for p in path) == pytest.approx(100.0 + 120.0 * math.cos(math.radians(112.0)), abs=1e-3)
    assert min(p[2] for p in path[first : last + 1]) == pytest.approx(100.0 + 120.0 * math.cos(math.radians(110.0)), abs=1e-3)
    assert np.sign(path[last][0] - path[first][0]) == direction
    dry_run(MACHINE, arc.plan(MACHINE))


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("opens", [1, -1])
def test_feed_in_and_feed_out_touch_the_helix_and_stay_on_its_sphere(direction, opens):
    plain = Helix("h", "S", "identify", CUP, 100.0, direction=direction, opens=opens)
    fed = Helix("h", "S", "identify", CUP, 100.0, direction=direction, opens=opens, feed_in_deg=20.0, feed_out_deg=15.0)
    path, measured = fed.path()
    assert path[measured[0] : measured[1] + 1] == plain.path()[0]
    p = np.array(path)
    assert np.abs(np.linalg.norm(p - CUP, axis=1) - 100.0).max() < 1e-4
    way = np.diff(p, axis=0) / np.linalg.norm(np.diff(p, axis=0), axis=1)[:, None]
    for k in measured:  # no sharper a corner at the joints than chords of 1 to 3 mm make on this sphere anyway
        assert way[k - 1] @ way[k] > math.cos(0.03)
    assert fed.plan(MACHINE).setup.document["feed_in_deg"] == 20.0
    assert "feed_in_deg" not in plain.plan(MACHINE).setup.document


def test_tests_about_one_cup_are_joined_on_the_sphere_and_never_through_it():
    """Two feeds, both directions, three planes and points: one cup, one bar, one mounting."""
    recipes = shared_setups(
        (
            Helix("fast", "S", "identify", CUP, 100.0, feed_mm_min=2000.0, turns=3.0),
            Helix("slow", "S", "identify", CUP, 100.0, feed_mm_min=500.0, turns=3.0),
            Helix("back", "S", "identify", CUP, 100.0, direction=-1, turns=3.0),
            Circle("xy", "S", "identify", CUP, 100.0, "XY"),
            Circle("xy-", "S", "identify", CUP, 100.0, "XY", direction=-1),
            Circle("yz", "S", "identify", CUP, 100.0, "YZ", -20.0, 220.0, 2.0, 2.0),
            Circle("zx", "S", "identify", CUP, 100.0, "ZX", -110.0, 220.0, 2.0, 2.0, direction=-1),
            HelixPoints("p", "S", "identify", CUP, 100.0, points=30),
        ),
        "f",
    )
    plans = [r.plan(MACHINE) for r in recipes]
    steps = [s for p in plans for s in p.steps]
    assert [type(s) for s in steps if isinstance(s, MountBar | Unmount)] == [MountBar, Unmount]
    here, mounted = None, False
    for step in steps:
        mounted |= isinstance(step, MountBar)
        places = [step.target_mm] if isinstance(step, MoveTo) else list(getattr(step, "points_mm", ()))
        for there in places:
            if mounted and here is not None and here != CUP:
                t = np.linspace(0.0, 1.0, 9)[:, None]
                along = np.array(here) + t * (np.array(there) - here)
                assert np.abs(np.linalg.norm(along - CUP, axis=1) - 100.0).max() < 0.9  # the stroke of the bar is 1 mm
            here = there
    dry_run_campaign(MACHINE, CampaignPlan("n", tuple(plans)))


def test_point_by_point_every_axis_arrives_the_way_its_places_follow_each_other():
    recipe = HelixPoints("p", "S", "identify", CUP, 100.0, points=60)
    plan = recipe.plan(MACHINE)
    places = np.array(recipe.path()[0])
    wanted = travel_sign(places)
    here, arrived, k = None, np.zeros(3), 0
    for step in plan.steps:
        if isinstance(step, ReadBar):
            assert here == pytest.approx(places[k])
            moving = np.abs(np.diff(places, axis=0)[max(k - 1, 0)]) > 1e-8
            assert (arrived[moving] == wanted[k][moving]).all()
            k += 1
        for there in [step.target_mm] if isinstance(step, MoveTo) else getattr(step, "points_mm", ()):
            if here is not None:
                moved = np.subtract(there, here)
                arrived = np.where(np.abs(moved) > 1e-8, np.sign(moved), arrived)
            here = there
    assert k == 60
    assert plan.setup.document["points"] == 60


@pytest.mark.parametrize("cycles", [1, 5])
def test_every_target_is_approached_from_the_side_that_its_direction_names(cycles):
    plan = Linear("l", "S", "identify", 1, positions=11, at_share=(0.5, 0.5), cycles=cycles, overrun_mm=2.0, offset_share=0.3, seed=4).plan(
        MACHINE
    )
    assert all(np.sign(came) == direction for came, direction, _ in approaches(plan, 1))
    targets = [at for _, _, at in approaches(plan, 1)]
    assert len(targets) == cycles * 2 * (11 + 1) + 1
    assert len(set(targets)) == 11 + 2
    inner = sorted(set(targets))[1:-1]
    even = np.linspace(10.0, 490.0, 11)
    assert 1.0 < np.abs(np.subtract(inner, even)).max() < 0.3 * 48.0  # pseudo-random, less than its share of the interval
    assert inner == sorted(inner)
    again = Linear(
        "l", "S", "identify", 1, positions=11, at_share=(0.5, 0.5), cycles=cycles, overrun_mm=2.0, offset_share=0.3, seed=4
    ).plan(MACHINE)
    assert again == plan
    # the exchange file says the same: directions of travel follow from the positions, overruns included
    rows = np.zeros((len(targets), 3))
    rows[:, 1] = targets
    assert (travel_sign(rows)[:, 1] == [d for _, d, _ in approaches(plan, 1)]).all()


def approaches(plan, axis):
    """Signed last motion, named direction and position of every reading."""
    here, came, out = None, 0.0, []
    for step in plan.steps:
        if isinstance(step, MoveTo):
            came = 0.0 if here is None else step.target_mm[axis] - here
            here = step.target_mm[axis]
        elif isinstance(step, ReadLaser):
            out.append((came, step.direction, here))
    return out


@pytest.mark.parametrize(("plane", "diagonal"), [(p, d) for p, ds in FACES.items() for d in ds])
def test_the_six_face_diagonals_move_two_axes(plane, diagonal):
    plan = FaceDiagonal("f", "S", "identify", plane, diagonal, steps=8, at_share=0.25, cycles=2, overrun_mm=1.0).plan(MACHINE)
    start, end = plan.setup.ends_mm
    a, b = ("XYZ".index(c) for c in plane)
    assert np.sign(end - start)[[a, b]].tolist() == [1.0 if diagonal[0] == "p" else -1.0, 1.0]
    assert end[3 - a - b] == start[3 - a - b]
    assert sum(isinstance(s, ReadLaser) for s in plan.steps) == 2 * 2 * (9 + 1) + 1
    dry_run(MACHINE, plan)


def test_repeats_of_step_diagonals_go_the_same_way_in_both_orders():
    for order in ("XYZ", "ZYX"):
        once, twice = (Diagonal("d", "S", "identify", "npp", 4, order, cycles=c).plan(MACHINE) for c in (1, 2))
        read = [[s.direction for s in p.steps if isinstance(s, ReadLaser)] for p in (once, twice)]
        assert read[1] == read[0] * 2
    with pytest.raises(ConfigError, match="no overrun"):
        Diagonal("d", "S", "identify", "npp", 4, "XYZ", overrun_mm=1.0).plan(MACHINE)


def test_ways_on_the_sphere_go_over_the_pole_where_the_short_way_would_be_under_the_cup():
    centre, up = np.zeros(3), np.array([0.0, 0.0, 1.0])
    for start, end in (([100.0, 0, 0], [-100.0, 0, 0]), ([0, 60.0, -80.0], [0, -60.0, -80.0])):
        way = way_on_sphere(centre, np.array(start), np.array(end), up, 2.0)
        assert way[0] == pytest.approx(start)
        assert way[-1] == pytest.approx(end)
        assert way[:, 2].max() == pytest.approx(100.0)
        assert np.linalg.norm(way, axis=1) == pytest.approx(np.full(len(way), 100.0))
        assert max(math.dist(a, b) for a, b in pairwise(way)) < 2.01
    short = way_on_sphere(centre, np.array([100.0, 0, 0]), np.array([0, 100.0, 0]), up, 2.0)
    assert np.abs(short[:, 2]).max() < 1e-9


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: circle_points(np.zeros(3), 1.0, "XX", np.zeros(1)), "plane"),
        (lambda: circle_points(np.zeros(3), 0.0, "XY", np.zeros(1)), "radius"),
        (lambda: arc_through(np.zeros(3), np.zeros(3), np.ones(3), np.zeros(1)), "centre"),
        (lambda: arc_through(np.zeros(3), np.eye(3)[0], np.eye(3)[0], np.zeros(1)), "along"),
        (lambda: face_ends(MACHINE.stroke_mm, "XY", "pn", 0.5), "pp or np"),
        (lambda: target_shares(5, 0.5, 1), "below 0.5"),
        (lambda: cycles_of(np.eye(3), 0), "1 or more"),
    ],
)
def test_impossible_geometry_is_refused(call, says):
    with pytest.raises(ValueError, match=says):
        call()
