"""Proposed measurements become recipes that the machine can run, beside what was measured."""

from __future__ import annotations

import numpy as np
import pytest

from service.sequences.steps import MountBar, RecordPath, Unmount
from service.site import machine_from_doc
from service.workflows.discovery_words import ADDS
from service.workflows.next_recipes import MAKERS, next_plan
from tests.unit.service.discovery_bench import MACHINE, Doc

HELIX: Doc = {
    "test": "ballbar_helix",
    "setup": {"setup_id": "A", "centre_mm": [300.0, 250.0, 100.0], "radius_mm": 150.0, "turns": 4},
    "columns": {"feed_mm_min": [1500.0], "direction": [1]},
}


@pytest.mark.parametrize("add", sorted(ADDS))
@pytest.mark.parametrize("runs", [[HELIX], []])
def test_every_addition_is_planned_or_left_to_a_person(add: str, runs: list[Doc]) -> None:
    found = next_plan([add], machine_from_doc(MACHINE), runs, name=("next1 now", "n1"), max_feed_mm_min=6000.0)
    if add not in MAKERS:
        assert (found.plan, found.by_hand) == (None, (add,))
        return
    assert found.plan is not None
    assert found.by_hand == ()
    assert all(t.label.startswith("n1-") and t.setup["setup_id"].startswith("n1-") for t in found.plan.tests)
    assert all(t.role == "identify" for t in found.plan.tests)


def test_the_additions_differ_from_the_first_helix_as_they_say() -> None:
    machine = machine_from_doc(MACHINE)

    def path(add: str) -> tuple[RecordPath, Doc]:
        plan = next_plan([add], machine, [HELIX], name=("x", "n1"), max_feed_mm_min=6000.0).plan
        assert plan is not None
        return next(s for s in plan.tests[0].steps if isinstance(s, RecordPath)), plan.tests[0].setup

    late, setup = path("longer_session")
    assert (late.feed_mm_min, late.direction, setup["radius_mm"]) == (1500.0, 1, 150.0)
    assert path("second_feed")[0].feed_mm_min == pytest.approx(600.0)
    assert path("opposite_direction")[0].direction == -1
    assert path("second_radius")[1]["radius_mm"] == pytest.approx(90.0)


def test_a_centre_without_room_for_a_hemisphere_gets_a_shorter_bar() -> None:
    high = HELIX | {"setup": HELIX["setup"] | {"centre_mm": [300.0, 250.0, 350.0]}}
    plan = next_plan(["second_feed"], machine_from_doc(MACHINE), [high], name=("x", "n1"), max_feed_mm_min=6000.0).plan
    assert plan is not None
    assert plan.tests[0].setup["radius_mm"] == pytest.approx(75.0)


def test_a_place_is_passed_by_a_denser_path_on_a_smaller_sphere() -> None:
    other = HELIX | {"run_id": "r07", "setup": HELIX["setup"] | {"setup_id": "B", "centre_mm": [200.0, 250.0, 100.0]}}
    place = np.array([200.0, 250.0, 100.0]) + 150.0 * np.array([-0.6, 0.0, 0.8])  # on the second one's sphere
    about = {"position_mm": place.tolist(), "radius_mm": 20.0, "runs": ["r07"]}
    plan = next_plan(
        ["second_radius"], machine_from_doc(MACHINE), [HELIX, other], name=("x", "n1"), max_feed_mm_min=6000.0, about=about
    ).plan
    assert plan is not None
    setup = plan.tests[0].setup
    assert setup["radius_mm"] == pytest.approx(90.0)
    assert setup["turns"] == 8.0
    path = np.array(next(s for s in plan.tests[0].steps if isinstance(s, RecordPath)).points_mm)
    assert np.min(np.linalg.norm(path - place, axis=1)) < 12.0
    assert np.linalg.norm(place - np.array(setup["centre_mm"])) == pytest.approx(90.0, abs=1e-3)


def test_what_came_at_a_moment_is_waited_for_in_one_set_up() -> None:
    other = HELIX | {"run_id": "r07", "setup": HELIX["setup"] | {"setup_id": "B", "centre_mm": [320.0, 240.0, 100.0]}}
    plan = next_plan(
        ["longer_session"], machine_from_doc(MACHINE), [HELIX, other], name=("x", "n1"), max_feed_mm_min=6000.0, about={"runs": ["r07"]}
    ).plan
    assert plan is not None
    assert [t.label for t in plan.tests] == ["n1-late1", "n1-late2", "n1-late3"]
    assert {t.setup["setup_id"] for t in plan.tests} == {"n1-late"}
    assert {tuple(t.setup["centre_mm"]) for t in plan.tests} == {(320.0, 240.0, 100.0)}
    paths = [next(s for s in t.steps if isinstance(s, RecordPath)) for t in plan.tests]
    assert [p.direction for p in paths] == [1, -1, 1]
    assert paths[0].points_mm[-1] == paths[1].points_mm[0]  # the bar stays in between
    assert [sum(isinstance(s, MountBar) for s in t.steps) for t in plan.tests] == [1, 0, 0]
    assert [sum(isinstance(s, Unmount) for s in t.steps) for t in plan.tests] == [0, 0, 1]


def test_a_run_that_is_no_helix_is_left_to_a_person() -> None:
    circle = {"run_id": "r02", "test": "ballbar_circle"}
    for add in ("longer_session", "ballbar"):
        found = next_plan(
            [add], machine_from_doc(MACHINE), [HELIX, circle], name=("x", "n1"), max_feed_mm_min=6000.0, about={"runs": ["r02"]}
        )
        assert (found.plan, found.by_hand) == (None, (add,))
