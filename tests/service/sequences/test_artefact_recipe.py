"""The recipe of an artefact: its file, its way, and what it refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from abbe.service.errors import ConfigError, StrokeError
from abbe.service.sequences.check import dry_run
from abbe.service.sequences.nc.blocks import program
from abbe.service.sequences.recipes.artefact import ArtefactTest, verifying_poses
from abbe.service.sequences.recipes.recipe_file import parse_recipe, recipe_text
from abbe.service.sequences.steps import CampaignPlan, MountArtefact, MoveTo, TouchFeature, Unmount
from tests.faults.sequencer_world import MACHINE, PLATE

TEST = ArtefactTest("p0", "P0", "identify", "A", (250.0, 200.0, 200.0), plate=PLATE)


def touches(test: ArtefactTest) -> list[TouchFeature]:
    return [s for s in test.plan(MACHINE).steps if isinstance(s, TouchFeature)]


def test_the_file_brings_back_the_same_recipe_with_its_artefact():
    turned = replace(TEST, label="p1", setup_id="P1", rotation_deg=(0.0, 0.0, 90.0))
    name, recipes = parse_recipe(recipe_text("plate", (TEST, turned)), "plate.toml")
    assert name == "plate"
    assert recipes == (TEST, turned)


def test_steps_are_up_mount_touch_and_clear_away():
    steps = TEST.plan(MACHINE).steps
    assert [type(s) for s in steps[:2]] == [MoveTo, MountArtefact]
    assert steps[0].target_mm[2] == MACHINE.stroke_mm[2, 1]
    assert isinstance(steps[-1], Unmount)
    assert [s.feature for s in touches(replace(TEST, requalify_every=4))] == ["A1", "B1", "C1", "A2", "A1", "B2", "C2", "A1"]


def test_a_turned_plate_is_touched_where_it_lies_in_directions_of_the_machine():
    one, two, three = touches(replace(TEST, rotation_deg=(0.0, 0.0, 90.0)))[:3]
    assert two.centre_mm == (250.0, 275.0, 194.0), "B1 lies along Y, 6 mm below the top"
    assert one.sides[0] == (1.0, 0.0, 0.0)
    assert three.start_deg == 45.0
    assert three.sides[0] == pytest.approx((0.5**0.5, 0.5**0.5, 0.0))


def test_a_ball_is_touched_at_its_top_and_around():
    balls = PLATE.model_copy(update={"features": [f.model_copy(update={"sensed": "xyz"}) for f in PLATE.features]})
    one = touches(replace(TEST, plate=balls))[0]
    assert (one.inside, one.radius_mm, len(one.sides)) == (False, 13.0, 5)
    assert one.before_mm(one.sides[0]) == (250.0, 200.0, 213.8)
    assert one.beyond_mm(one.sides[1])[0] == pytest.approx(250.0 + 12.2)
    assert all(np.array(p)[2] >= 200.0 for p in one.places_mm())


def test_the_dry_run_checks_strokes_and_counts_features_and_minutes():
    run = dry_run(MACHINE, TEST.plan(MACHINE))
    assert run.readings == 7
    assert 30.0 < run.duration_s < 120.0
    with pytest.raises(StrokeError, match="X would go to"):
        dry_run(MACHINE, replace(TEST, origin_mm=(560.0, 200.0, 200.0)).plan(MACHINE))


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"plate": None}, "the recipe has no artefact 'A'"),
        ({"stylus_radius_mm": 9.0}, "no room for a stylus of 9 mm radius"),
        ({"plate": PLATE.model_copy(update={"features": [PLATE.features[0].model_copy(update={"radius_mm": None})]})}, "with radius_mm"),
    ],
)
def test_what_cannot_be_touched_is_named(change, what):
    with pytest.raises(ConfigError, match=what):
        replace(TEST, **change).plan(MACHINE)


def test_an_nc_program_does_not_touch():
    with pytest.raises(ConfigError, match="cannot probe an artefact"):
        program("m", CampaignPlan("plate", (TEST.plan(MACHINE),)), MACHINE.stroke_mm)


def test_poses_that_verify_a_table_are_kept_out_of_the_solution():
    plan = verifying_poses(MACHINE, "check", (TEST,))
    assert [t.role for t in plan.tests] == ["holdout"]
    with pytest.raises(ConfigError, match="allows only tests of kind"):
        verifying_poses(MACHINE, "check", (TEST, object()))


def test_balls_are_touched_along_the_stylus_however_the_plate_is_tilted_and_holes_only_if_it_is_not():
    balls = PLATE.model_copy(update={"features": [f.model_copy(update={"sensed": "xyz"}) for f in PLATE.features]})
    tilted = touches(replace(TEST, plate=balls, rotation_deg=(30.0, 0.0, 0.0)))
    assert {t.up for t in tilted} == {(0.0, 0.0, 1.0)}
    with pytest.raises(ConfigError, match="its hole is tilted by 30 degrees against the stylus"):
        replace(TEST, rotation_deg=(30.0, 0.0, 0.0)).plan(MACHINE)


def test_balls_without_room_between_them_for_the_stylus_are_refused():
    radius, pitch = PLATE.features[0].radius_mm, PLATE.features[1].nominal_mm[0]
    big = 0.5 * pitch - 2.0
    balls = PLATE.model_copy(update={"features": [f.model_copy(update={"sensed": "xyz", "radius_mm": big}) for f in PLATE.features]})
    assert radius < big
    with pytest.raises(ConfigError, match=r"feature A1: the stylus comes within -?\d+\.\d mm of B1"):
        replace(TEST, plate=balls).plan(MACHINE)
