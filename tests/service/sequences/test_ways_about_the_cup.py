"""Ball-bar motions about a cup that stands: never straight past or through it, never low under it unless the recipe says so."""

import math
import os
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from abbe.models.machine import Machine
from abbe.models.paths import way_on_sphere
from abbe.service.errors import StrokeError
from abbe.service.sequences.check import dry_run
from abbe.service.sequences.recipes.recipe import Circle, CircleArc
from abbe.service.sequences.recipes.recipe_file import parse_recipe, recipe_text, shared_setups
from abbe.service.sequences.resume_plan import end_of, remounted, rest_of
from abbe.service.sequences.steps import ChangeBar, FollowPath, MountBar, MoveTo, RecordPath, TakeBarOut

LONG = os.environ.get("ABBE_TEST_LONG") == "1"
MACHINE = Machine("w-X-Y-b-Z-t", np.array([[0.0, 600.0], [0.0, 500.0], [0.0, 450.0]]))
CUP = (300.0, 250.0, 200.0)
UPRIGHT = ("YZ", -20.0, 220.0, 2.0, 2.0)


def legs(steps, here=None):
    """Every straight leg from where the machine stands: start, end."""
    for step in steps:
        for there in [step.target_mm] if isinstance(step, MoveTo) else getattr(step, "points_mm", ()):
            if here is not None and here != there:
                yield here, there
            here = there


def clear_mm(steps, here=None):
    """Nearest that the legs come to the cup's centre or to the post below it, mm; the way straight up from the centre does not count."""
    nearest = math.inf
    for a, b in legs(steps, here):
        along = np.array(a) + np.linspace(0.0, 1.0, 401)[:, None] * np.subtract(b, a) - CUP
        beside = np.hypot(along[:, 0], along[:, 1])
        if beside.max() < 1e-9 and along[-1, 2] > 0.0:  # on the axis, above
            off = np.array([np.inf]) if a == CUP else along[:, 2]
        else:
            off = np.where(along[:, 2] < 0.0, beside, np.linalg.norm(along, axis=1))
        nearest = min(nearest, float(off.min()))
    return nearest


def after_mounting(plan):
    k = next(k for k, s in enumerate(plan.steps) if isinstance(s, MountBar))
    return plan.steps[k + 1 :]


RADII = [(150.0, 50.0), (50.0, 150.0)]
PLANES = [("XY", "ZX"), ("XY", "YZ"), ("ZX", "XY"), ("YZ", "ZX"), ("XY", "XY")]
# Every pair of planes with both orders of the bars, directions in turn; ABBE_TEST_LONG=1 plays all.
PAIRS = [(r, p, d) for k, p in enumerate(PLANES) for j, r in enumerate(RADII) for d in ((1, -1) if LONG else ((1, -1)[(k + j) % 2],))]


@pytest.mark.parametrize(("radii", "planes", "direction"), PAIRS)
def test_another_bar_is_reached_over_the_pole_and_along_its_own_sphere(radii, planes, direction):
    pair = [Circle(k, "S", "identify", CUP, r, p, direction=direction) for k, r, p in zip("ab", radii, planes, strict=True)]
    first, second = (r.plan(MACHINE) for r in shared_setups(tuple(pair), "f"))
    assert isinstance(second.steps[0], TakeBarOut)
    assert any(isinstance(s, ChangeBar) for s in second.steps)
    assert clear_mm(after_mounting(first), CUP) > 0.9 * radii[0]
    assert clear_mm(second.steps, end_of(first)) > 0.9 * min(radii)
    dry_run(MACHINE, second)
    # and where the test is broken off on that way, the machine goes back along it
    left, offset, resume_trail, _ = rest_of(second, 0, (), end_of(first))
    assert offset == 1
    assert resume_trail.trail[0] == end_of(first)
    assert clear_mm(left.steps, resume_trail.trail[resume_trail.to]) > 0.9 * min(radii)


def test_each_end_is_held_against_its_own_bar_where_bars_are_changed():
    low = {"feed_in_deg": 0.0, "feed_out_deg": 0.0, "under_the_cup": True}
    small = Circle("a", "S", "identify", CUP, 50.0, "ZX", 0.0, 130.0, **low)  # ends 0.64 of its own radius below, 0.21 of the other's
    large = Circle("b", "S", "identify", CUP, 150.0, "ZX")
    with pytest.raises(Exception, match="below the cup"):
        shared_setups((small, large), "f")


@pytest.mark.parametrize("opens", [1, -1])
@pytest.mark.parametrize("plane", ["YZ", "ZX"])
def test_from_the_centre_the_way_to_a_low_start_is_over_the_pole(plane, opens):
    plan = Circle("c", "S", "identify", CUP, 120.0, plane, opens=opens).plan(MACHINE)
    there = after_mounting(plan)
    pole = (CUP[0], CUP[1], CUP[2] + opens * 120.0)
    assert there[0].target_mm == pole
    assert isinstance(there[1], FollowPath)
    mirrored = [replace(s, points_mm=tuple((x, y, 2 * CUP[2] - z) for x, y, z in s.points_mm)) for s in there if hasattr(s, "points_mm")]
    assert clear_mm(mirrored if opens < 0 else there, None if opens < 0 else CUP) > 0.9 * 120.0
    dry_run(MACHINE, plan)


def test_upright_planes_have_the_partial_arc_unless_the_recipe_says_more():
    arc = Circle("c", "S", "identify", CUP, 150.0, "ZX").arc()
    assert arc == CircleArc(begin_deg=-110.0, span_deg=220.0, feed_in_deg=2.0, feed_out_deg=2.0)
    assert Circle("c", "S", "identify", CUP, 150.0, "YZ").arc().begin_deg == -20.0
    assert Circle("c", "S", "identify", CUP, 150.0, "XY").arc() == CircleArc(
        begin_deg=0.0, span_deg=360.0, feed_in_deg=180.0, feed_out_deg=180.0
    )
    assert Circle("c", "S", "identify", CUP, 150.0, "XY", axis=0).arc().span_deg == 220.0
    for plane, opens, axis in (("YZ", 1, 2), ("ZX", -1, 2), ("XY", -1, 0), ("XY", 1, 1), ("ZX", 1, 0)):
        dry_run(MACHINE, Circle("c", "S", "identify", CUP, 150.0, plane, opens=opens, axis=axis).plan(MACHINE))


def test_a_path_under_the_cup_is_refused_unless_the_recipe_says_that_there_is_room():
    whole = Circle("c", "S", "identify", CUP, 150.0, "ZX", span_deg=360.0)
    with pytest.raises(StrokeError, match=r"test c: the path goes 150 mm below the centre of the cup.*under_the_cup"):
        dry_run(MACHINE, whole.plan(MACHINE))
    allowed = replace(whole, under_the_cup=True)
    dry_run(MACHINE, allowed.plan(MACHINE))
    _, (again,) = parse_recipe(recipe_text("n", (allowed,)), "f")
    assert again.path() == allowed.path()
    assert again.under_the_cup


@pytest.mark.parametrize("second", [Circle("b", "S", "identify", CUP, 150.0, *UPRIGHT), Circle("b", "S", "identify", CUP, 50.0, *UPRIGHT),
                                    Circle("b", "S", "identify", CUP, 150.0, "XY")])  # fmt: skip
def test_a_test_that_is_mounted_anew_goes_from_the_centre_over_the_pole(second):
    recipes = shared_setups((Circle("a", "S", "identify", CUP, 150.0, "XY"), second), "f")
    first, other = (r.plan(MACHINE) for r in recipes)
    again = remounted(other, first, 2)
    assert not any(isinstance(s, TakeBarOut | ChangeBar) for s in again.steps)
    (mount,) = (s for s in again.steps if isinstance(s, MountBar))
    assert mount.radius_mm == second.radius_mm
    steps = after_mounting(again)
    assert clear_mm(steps, CUP) > 0.9 * second.radius_mm
    recorded = next(s for s in steps if isinstance(s, RecordPath))
    before = steps[steps.index(recorded) - 1]
    assert before.target_mm == recorded.points_mm[0]
    dry_run(MACHINE, again)


def test_a_short_way_between_low_points_does_not_pass_the_foot_of_the_cup():
    up = np.array([0.0, 0.0, 1.0])
    for low in (170.0, 175.0):
        start, end = (100.0 * np.array([s * math.sin(math.radians(low)), 0.0, math.cos(math.radians(low))]) for s in (1.0, -1.0))
        way = way_on_sphere(np.zeros(3), start, end, up, 2.0)
        assert way[:, 2].min() >= start[2] - 1e-9
        assert max(math.dist(a, b) for a, b in pairwise(way)) < 2.01
