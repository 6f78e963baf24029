"""`abbe plan --artefact`: poses inside the strokes, in the order of what they tell, as a recipe."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest

from abbe.service.campaigns.plan_poses import TILT_DEG, _offered, plan_poses, pose_doc, pose_rows, read_artefact
from abbe.service.devices.session import DeviceUrls
from abbe.service.domain.artefact import ArtefactObject
from abbe.service.domain.machine import machine_doc
from abbe.service.errors import ConfigError
from abbe.service.sequences.check import dry_run
from abbe.service.sequences.recipes.recipe_file import parse_recipe
from abbe.service.site import Site
from tests.faults.sequencer_world import MACHINE

SITE = Site("sim", MACHINE, machine_doc("sim", MACHINE), DeviceUrls())


def plate(pitch_mm: float = 60.0, columns: int = 4, sensed: str = "xy", radius_mm: float = 10.0) -> ArtefactObject:
    features = [
        {"id": f"{'ABCDEF'[i]}{j + 1}", "nominal_mm": [pitch_mm * i, pitch_mm * j, 0.0], "sensed": sensed, "radius_mm": radius_mm}
        for j in range(columns)
        for i in range(columns)
    ]
    length = {"from": "A1", "to": "B1", "length_mm": pitch_mm, "U_mm": 0.0004}
    return ArtefactObject.read({"kind": "hole_plate", "features": features, "calibrated_lengths": [length]})


def test_every_pose_fits_tells_more_and_is_paid_for():
    found = plan_poses(SITE, "A", plate(), 36.0)
    assert 2 <= len(found.poses) <= 4
    assert found.poses[-1].until_min <= 36.0
    ranks = [p.rank.rank for p in found.poses if p.rank is not None]
    assert ranks == sorted(ranks)
    assert ranks[-1] >= 22
    means = [p.u_mean_mm for p in found.poses]
    assert means == sorted(means, reverse=True)
    name, recipes = parse_recipe(found.text, "plan.toml")
    assert name.startswith("A ")
    for recipe in recipes:
        dry_run(MACHINE, recipe.plan(MACHINE))
    assert len(pose_rows(found)) == len(pose_doc(found)["poses"]) == len(recipes)


def test_balls_are_tilted_too_and_that_tells_more_of_space_than_flat_poses_do():
    found = plan_poses(SITE, "A", plate(80.0, 2, "xyz"), 40.0)
    tilts = [p.recipe.rotation_deg[0] for p in found.poses]
    assert tilts[0] == 0.0
    assert TILT_DEG in tilts
    (_, before), (tilted, after) = next((a, b) for a, b in pairwise(zip(tilts, found.poses, strict=True)) if b[0])
    assert after.u_mean_mm < 0.98 * before.u_mean_mm
    assert "tilted by 30°" in pose_rows(found)[tilts.index(tilted)][1]
    for recipe in parse_recipe(found.text, "plan.toml")[1]:
        dry_run(MACHINE, recipe.plan(MACHINE))


def test_balls_that_the_stylus_would_meet_when_tilted_lie_flat():
    found = list(_offered(SITE, "A", plate(24.0, 2, "xyz", 8.0)))
    assert {recipe.rotation_deg[0] for recipe, _, _ in found} == {0.0}


@pytest.mark.parametrize(
    ("made", "minutes", "what"),
    [(lambda: plate(200.0), 60.0, "no pose has all its touches inside"), (plate, 5.0, "do not suffice for one pose")],
)
def test_what_cannot_be_planned_is_named(made, minutes, what):
    with pytest.raises(ConfigError, match=what):
        plan_poses(SITE, "A", made(), minutes)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("kind = 'plate'", r"expected one table \[artefact.NAME\]"),
        ("[artefact.A]\nkind = 'plate'", "artefact.A: .*features"),
    ],
)
def test_a_wrong_file_is_named(tmp_path: Path, text, what):
    (tmp_path / "plate.toml").write_text(text)
    with pytest.raises(ConfigError, match=what):
        read_artefact(tmp_path / "plate.toml")
