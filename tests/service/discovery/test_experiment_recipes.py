"""Proposed measurements become recipes that the machine can run, beside what was measured."""

from __future__ import annotations

import numpy as np
import pytest

from abbe.models.discovery.answer import Localization
from abbe.models.discovery.experiment.additions import REPEAT_LATE_S
from abbe.service.discovery.effect_pages import ADDS
from abbe.service.discovery.experiment_recipes import MAKERS, NO_HELIX, NO_PATH, TURNED, NextPlan, next_plan
from abbe.service.domain.machine import machine_from_doc
from abbe.service.domain.run import BarSetup
from abbe.service.sequences.recipes.recipe import Helix
from abbe.service.sequences.steps import MountBar, MoveTo, RecordPath, Unmount
from tests.run_documents import run_of, runs_of
from tests.service.discovery.discovery_bench import MACHINE, Doc

HELIX: Doc = {
    "test": "ballbar_helix",
    "setup": Helix("a", "A", "identify", (300.0, 250.0, 100.0), 150.0, turns=4).plan(machine_from_doc(MACHINE)).setup.document,
    "columns": {"feed_mm_min": [1500.0], "direction": [1]},
}


@pytest.mark.parametrize("add", sorted(ADDS))
@pytest.mark.parametrize("runs", [[HELIX], []])
def test_every_addition_is_planned_or_left_to_a_person(add: str, runs: list[Doc]) -> None:
    found = next_plan([add], machine_from_doc(MACHINE), runs_of(runs), name=("next1 now", "n1"), max_feed_mm_min=6000.0)
    if add not in MAKERS:
        assert (found.plan, found.by_hand) == (None, (add,))
        return
    assert found.plan is not None
    assert found.by_hand == ()
    assert found.after_s == (REPEAT_LATE_S if add == "longer_session" else 0.0)
    assert all(t.label.startswith("n1-") and t.setup_id.startswith("n1-") for t in found.plan.tests)
    assert {t.role for t in found.plan.tests} == {"holdout" if add == "judging_run" else "identify"}


def test_the_additions_differ_from_the_first_helix_as_they_say() -> None:
    machine = machine_from_doc(MACHINE)

    def path(add: str) -> tuple[RecordPath, BarSetup]:
        plan = next_plan([add], machine, [run_of(HELIX)], name=("x", "n1"), max_feed_mm_min=6000.0).plan
        assert plan is not None
        return next(s for s in plan.tests[0].steps if isinstance(s, RecordPath)), plan.tests[0].bar

    late, setup = path("longer_session")
    assert (late.feed_mm_min, late.direction, setup.radius_mm) == (1500.0, 1, 150.0)
    assert path("second_feed")[0].feed_mm_min == pytest.approx(600.0)
    assert path("opposite_direction")[0].direction == -1
    assert path("second_radius")[1].radius_mm == pytest.approx(90.0)


def test_a_centre_without_room_for_a_hemisphere_gets_a_shorter_bar() -> None:
    high = HELIX | {"setup": HELIX["setup"] | {"centre_mm": [300.0, 250.0, 380.0]}}
    plan = next_plan(["second_radius"], machine_from_doc(MACHINE), [run_of(high)], name=("x", "n1"), max_feed_mm_min=6000.0).plan
    assert plan is not None
    assert plan.tests[0].bar.radius_mm == pytest.approx(45.0)


@pytest.mark.parametrize("about", [None, Localization(position_mm=(300.0, 250.0, 400.0), runs=("r07",))])
def test_the_same_path_again_that_has_no_room_is_left_to_a_person(about: Localization | None) -> None:
    high = HELIX | {"run_id": "r07", "setup": HELIX["setup"] | {"centre_mm": [300.0, 250.0, 380.0]}}
    for add in ("second_feed", "longer_session"):
        found = next_plan([add], machine_from_doc(MACHINE), [run_of(high)], name=("x", "n1"), max_feed_mm_min=6000.0, about=about)
        assert found.plan is None
        assert "Z would go to" in found.by_hand[0]


@pytest.mark.parametrize("about", [None, Localization(runs=("r07",))])
def test_a_repeat_is_the_run_again_with_all_that_its_set_up_says(about: Localization | None) -> None:
    machine = machine_from_doc(MACHINE)
    like = Helix(
        "a", "A", "identify", (300.0, 200.0, 220.0), 120.0, turns=3.5, law="angle", axis=1, feed_mm_min=900.0, direction=-1, rate_hz=50,
        chord_mm=0.5, opens=-1, length_calibrated=False, u_length_mm=0.05, even=False,
    )  # fmt: skip
    old = like.plan(machine)
    run = HELIX | {"run_id": "r07", "setup": old.setup.document, "columns": {"feed_mm_min": [900.0], "direction": [-1]}}
    plan = next_plan(["longer_session"], machine, [run_of(run)], name=("x", "n1"), max_feed_mm_min=6000.0, about=about).plan
    assert plan is not None
    assert plan.tests[0].setup.named("A").document == old.setup.document
    assert next(s for s in plan.tests[0].steps if isinstance(s, RecordPath)) == next(s for s in old.steps if isinstance(s, RecordPath))


@pytest.mark.parametrize("lacks", ["opens", "axis", "law", "turns", "rate_hz"])
def test_a_helix_that_is_not_known_completely_is_not_guessed(lacks: str) -> None:
    run = HELIX | {"run_id": "r07", "setup": {k: v for k, v in HELIX["setup"].items() if k != lacks}}
    for add in ("longer_session", "second_feed", "opposite_direction", "second_radius"):
        found = next_plan([add], machine_from_doc(MACHINE), [run_of(run)], name=("x", "n1"), max_feed_mm_min=6000.0)
        assert found == NextPlan(None, (f"{add} ({NO_PATH})",))
    assert next_plan(["laser_diagonals"], machine_from_doc(MACHINE), [run_of(run)], name=("x", "n1"), max_feed_mm_min=6000.0).by_hand == ()


def test_moves_are_no_faster_than_the_machine_file_allows() -> None:
    plan = next_plan(["laser_diagonals"], machine_from_doc(MACHINE), [run_of(HELIX)], name=("x", "n1"), max_feed_mm_min=3000.0).plan
    assert plan is not None
    assert max(s.feed_mm_min for t in plan.tests for s in t.steps if isinstance(s, MoveTo)) == 3000.0


@pytest.mark.parametrize(("seen", "opens"), [((0.8, 0.6), 1), ((1.0, 0.0), 1), ((0.8, -0.6), -1)])
@pytest.mark.parametrize("away_mm", [20.0, 150.0])
def test_the_half_of_the_new_sphere_is_the_one_on_which_the_place_is_seen(seen: tuple[float, float], opens: int, away_mm: float) -> None:
    low = HELIX | {"run_id": "r07", "setup": HELIX["setup"] | {"centre_mm": [300.0, 250.0, 220.0]}}
    place = np.array([300.0, 250.0, 220.0]) + away_mm * np.array([seen[0], 0.0, seen[1]])
    about = Localization(position_mm=tuple(place.tolist()), runs=("r07",))
    plan = next_plan(
        ["second_radius"], machine_from_doc(MACHINE), [run_of(low)], name=("x", "n1"), max_feed_mm_min=6000.0, about=about
    ).plan
    assert plan is not None
    assert plan.tests[0].bar.opens == opens
    path = np.array(next(s for s in plan.tests[0].steps if isinstance(s, RecordPath)).points_mm)
    assert np.min(np.linalg.norm(path - place, axis=1)) < 12.0


def test_a_place_is_passed_by_a_denser_path_on_a_smaller_sphere() -> None:
    other = HELIX | {"run_id": "r07", "setup": HELIX["setup"] | {"setup_id": "B", "centre_mm": [200.0, 250.0, 100.0]}}
    place = np.array([200.0, 250.0, 100.0]) + 150.0 * np.array([-0.6, 0.0, 0.8])  # on the second one's sphere
    about = Localization(position_mm=tuple(place.tolist()), radius_mm=20.0, runs=("r07",))
    plan = next_plan(
        ["second_radius"], machine_from_doc(MACHINE), runs_of([HELIX, other]), name=("x", "n1"), max_feed_mm_min=6000.0, about=about
    ).plan
    assert plan is not None
    setup = plan.tests[0].setup
    assert setup.radius_mm == pytest.approx(90.0)
    assert setup.turns == 8.0
    path = np.array(next(s for s in plan.tests[0].steps if isinstance(s, RecordPath)).points_mm)
    assert np.min(np.linalg.norm(path - place, axis=1)) < 12.0
    assert np.linalg.norm(place - setup.centre_mm) == pytest.approx(90.0, abs=1e-3)


def test_what_came_at_a_moment_is_waited_for_in_one_set_up() -> None:
    other = HELIX | {"run_id": "r07", "setup": HELIX["setup"] | {"setup_id": "B", "centre_mm": [320.0, 240.0, 100.0]}}
    plan = next_plan(
        ["longer_session"],
        machine_from_doc(MACHINE),
        runs_of([HELIX, other]),
        name=("x", "n1"),
        max_feed_mm_min=6000.0,
        about=Localization(runs=("r07",)),
    ).plan
    assert plan is not None
    assert [t.label for t in plan.tests] == ["n1-late1", "n1-late2", "n1-late3"]
    assert {t.setup_id for t in plan.tests} == {"n1-late"}
    assert {tuple(t.bar.centre_mm) for t in plan.tests} == {(320.0, 240.0, 100.0)}
    paths = [next(s for s in t.steps if isinstance(s, RecordPath)) for t in plan.tests]
    assert [p.direction for p in paths] == [1, -1, 1]
    assert paths[0].points_mm[-1] == paths[1].points_mm[0]  # the bar stays in between
    assert [sum(isinstance(s, MountBar) for s in t.steps) for t in plan.tests] == [1, 0, 0]
    assert [sum(isinstance(s, Unmount) for s in t.steps) for t in plan.tests] == [0, 0, 1]


@pytest.mark.parametrize(
    ("add", "run", "why"), [("longer_session", "r02", NO_HELIX), ("ballbar", "r02", TURNED), ("ballbar", "r07", TURNED)]
)
def test_a_run_that_is_no_helix_and_a_bar_that_is_turned_are_left_to_a_person(add: str, run: str, why: str) -> None:
    runs = [HELIX | {"run_id": "r07"}, {"run_id": "r02", "test": "ballbar_circle"}]
    found = next_plan(
        [add], machine_from_doc(MACHINE), runs_of(runs), name=("x", "n1"), max_feed_mm_min=6000.0, about=Localization(runs=(run,))
    )
    assert found == NextPlan(None, (f"{add} ({why})",))
