"""Proposed measurements become recipes that the machine can run, beside what was measured."""

from __future__ import annotations

import pytest

from service.sequences.steps import RecordPath
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
