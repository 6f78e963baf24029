"""The stylus is qualified on a sphere on the table: before, again and again, after a pause; and what goes wrong there is named."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from abbe.service.campaign_data.campaign_folder import from_store
from abbe.service.campaigns.measure import MeasureOptions, measure
from abbe.service.domain.artefact import QualificationSphere
from abbe.service.domain.document import parsed
from abbe.service.domain.measured import TouchedFeature
from abbe.service.domain.run import FEATURE
from abbe.service.errors import ConfigError, MissedContact, ProbeUncalibrated, SetupDisturbed, Stopped
from abbe.service.runs.columns import load_run
from abbe.service.sequences.control import Control
from abbe.service.sequences.probing import check_same
from abbe.service.sequences.recipes.recipe_file import parse_recipe, recipe_text
from abbe.service.sequences.resume_plan import rest_of
from abbe.service.sequences.steps import CampaignPlan, TouchFeature
from abbe.service.storage.store import Store
from abbe.simulators.scenario import SphereConfig
from tests.faults.sequencer_world import PLATE, AtStep, Bench, bench, kinds, small

PLACE_MM, RADIUS_MM = (150.0, 200.0, 235.0), 12.5
ROW, PAIR, ONE = (PLATE.model_copy(update={"features": PLATE.features[:n]}) for n in (3, 2, 1))
SPHERE = QualificationSphere(id="S", centre_mm=PLACE_MM, radius_mm=RADIUS_MM, U_mm=0.0004)
QUALIFIED = {"plate": ONE, "turned_every": 0, "sphere": SPHERE, "requalify_every": 2}
Place = tuple[Bench, Store]


@pytest.fixture
async def place(tmp_path: Path):
    async with bench(tmp_path, sphere=SphereConfig(PLACE_MM, RADIUS_MM)) as b:
        b.sim.pace(100.0)
        with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
            yield b, store
        assert not b.sim.world.table.stylus.broken


def plan(**more: Any) -> CampaignPlan:
    return CampaignPlan("plate", (small("ArtefactTest", **(QUALIFIED | more)),))


def touches(made: CampaignPlan) -> list[tuple[int, TouchFeature]]:
    return [(k + 1, s) for k, s in enumerate(made.tests[0].steps) if isinstance(s, TouchFeature)]


async def run(place: Place, made: CampaignPlan, control: Control | None = None) -> None:
    await measure(place[0].session, place[1], place[0].site, made, options=MeasureOptions(control))


def test_the_sphere_comes_before_the_first_feature_and_before_that_is_touched_again():
    made = touches(plan(plate=ROW))
    assert [s.feature for _, s in made] == ["S", "A1", "B1", "S", "A1", "C1", "S", "A1"]
    assert {s.above_mm[2] for _, s in made} == {PLACE_MM[2] + RADIUS_MM + 3.0 + 20.0}, "all ways lie above everything"


def test_the_file_brings_the_sphere_back():
    recipe = kinds()["ArtefactTest"]("p", "p", "identify", "A", (250.0, 200.0, 200.0), plate=ROW, sphere=SPHERE)
    assert parse_recipe(recipe_text("plate", (recipe,)), "plate.toml")[1] == (recipe,)


def test_a_sphere_with_the_name_of_a_feature_is_refused():
    with pytest.raises(ConfigError, match="sphere and feature are both called 'A1'"):
        plan(sphere=SPHERE.model_copy(update={"id": "A1"}))


async def test_the_qualified_radius_is_that_of_the_ball_less_its_pretravel_and_the_sphere_is_no_feature(place):
    b, store = place
    await run(place, plan())
    (found,) = from_store(store, "plate").runs
    assert list(found.columns.further[FEATURE]) == ["A1", "A1"]
    radius, u = (found.setup.document[key] for key in ("tool_radius_mm", "u_tool_radius_mm"))
    stylus = b.sim.world.table.stylus
    around = stylus.radius_mm - stylus.pretravel_mm  # the top is reached with less pre-travel, and weighs little
    assert abs(radius - around) < 2.0 * u
    assert 0.001 <= u < 0.0015, "lobing, the sphere, and a little"
    alone = load_run(store, store.runs.all()[0].id)
    assert alone.setup.document["tool_radius_mm"] == radius


async def test_a_sphere_that_is_not_there_is_named(place):
    place[0].sim.world.table.sphere_radius_mm = 0.0
    with pytest.raises(MissedContact, match=r"qualification sphere S: no contact within 0\.8 mm"):
        await run(place, plan())
    assert place[0].sim.world.controller.position_mm[2] > PLACE_MM[2] + RADIUS_MM, "above the place of the sphere"


async def test_another_sphere_or_stylus_than_stated_is_named(place):
    wrong = SPHERE.model_copy(update={"radius_mm": RADIUS_MM + 0.3})
    with pytest.raises(ProbeUncalibrated, match=r"qualification sphere S: its radius comes out 0\.3\d+ mm too small"):
        await run(place, plan(sphere=wrong))


async def test_a_stylus_that_changes_is_named_at_the_sphere_and_the_pose_begins_anew(place):
    b, store = place
    made, stylus = plan(), b.sim.world.table.stylus
    worn = AtStep(touches(made)[2][0], lambda: setattr(stylus, "radius_mm", stylus.radius_mm - 0.02))
    await run(place, made, worn)
    first, second = store.runs.all()
    expected = r"SEQ-008: qualification sphere S: its radius changed by -(19|20)\.\d ± \d\.\d um \(features touched meanwhile: 1\)"
    assert re.match(expected, first.reason)
    assert (first.status, second.start_doc["setup"]["setup_id"]) == ("failed", "S-2")


async def test_after_a_pause_the_sphere_is_touched_before_the_first_feature_and_then_the_next(place):
    b, _ = place
    made = plan(plate=PAIR)
    second, paused_s = touches(made)[2][0], list[float]()

    class Once(AtStep):
        """Pauses at the second feature, and stops after it."""

        def place(self, step: int, steps: int, points: int) -> None:
            super().place(step, steps, points)
            if step == second + 1:
                self.stop()

        async def resumed(self) -> None:
            paused_s.append(b.sim.now_s())
            self.resume()
            await super().resumed()

    control = Once(second, lambda: control.pause())
    with pytest.raises(Stopped):
        await run(place, made, control)
    assert touched_places(b, paused_s[0]) == [PLACE_MM[0], 250.0, 325.0], "sphere, A1, B1"


def touched_places(b: Bench, after_s: float) -> list[float]:
    """X of what was touched after a time: middle of the slow touches in turn."""
    at = np.array([1e-5 * c.args[0] for c in b.sim.motions(after_s) if c.kind == "touch" and c.args[-1] == 30_000])
    groups = np.split(at, np.flatnonzero(np.abs(np.diff(at)) > 40.0) + 1)
    return [float(np.round(0.5 * (g.min() + g.max()))) for g in groups]


def test_resumed_both_are_touched_again_and_the_records_so_far_are_kept():
    (made,) = plan(plate=PAIR).tests
    records = ({"feature": "S", "u_sphere_mm": 2e-4}, {"feature": "A1"})
    rest, _, trail, _ = rest_of(made, 1, records, None)
    assert [one.feature for one in trail.again] == ["S", "A1"]
    assert (trail.carried, trail.n_features) == (records, 1), "the sphere is no feature"
    assert [s.feature for s in rest.steps if isinstance(s, TouchFeature)] == ["B1", "S", "A1"]
    assert [one.feature for one in rest_of(made, 1, records[:1], None)[2].again] == ["S"]


def test_a_sphere_that_moved_is_told_from_an_artefact_that_did():
    steps = {s.feature: s for _, s in touches(plan())}
    for name, why in (
        ("S", "qualification sphere S moved by 50 um .*: the stylus was changed"),
        ("A1", "feature A1 moved .*: the artefact"),
    ):
        first, later = touched(steps[name], 0.0), touched(steps[name], 0.05)
        check_same(first, [first])
        with pytest.raises(SetupDisturbed, match=why):
            check_same(later, [first])


def touched(step: TouchFeature, off_mm: float) -> TouchedFeature:
    """What exact touches of a feature give that lies so far off in X."""
    centre = np.add(step.centre_mm, [off_mm, 0.0, 0.0])
    at = [[(centre + step.radius_mm * np.array(side)).tolist()] * 2 for side in step.sides]
    return parsed(TouchedFeature, {
        "feature": step.feature, "inside": step.inside, "nominal_mm": step.nominal_mm, "target_mm": step.centre_mm, "sides": step.sides,
        "touches_mm": at, "start_deg": 0.0, "radius_mm": step.radius_mm, "u_sphere_mm": step.u_sphere_mm,
    })  # fmt: skip
