"""A set-up that was broken off is not gone on with: somebody takes out what hangs there, and it is mounted anew under another name."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from abbe.models.discovery.answer import Localization
from abbe.service.campaign_data.campaign_folder import Campaign, ensure_stored, from_folder
from abbe.service.discovery.discover_live import LiveAddition, find_addition
from abbe.service.discovery.experiment_recipes import next_plan
from abbe.service.domain.machine import machine_from_doc
from abbe.service.domain.measured import Owner
from abbe.service.runs.cases import case_of
from abbe.service.sequences.recipes.recipe import Helix
from abbe.service.sequences.steps import CampaignPlan, MountBar, MoveTo, RecordPath, TestPlan, Unmount
from abbe.service.storage.store import Store
from tests.run_documents import run_of
from tests.service.discovery.discovery_bench import MACHINE, Doc, write_case

LIKE = Helix("a", "A", "identify", (300.0, 250.0, 100.0), 150.0, turns=4).plan(machine_from_doc(MACHINE))
RUN: Doc = {"run_id": "r07", "test": LIKE.test, "setup": LIKE.setup.document, "columns": {"feed_mm_min": [1500.0], "direction": [1]}}
LABELS = ["n1-late1", "n1-late2", "n1-late3"]


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Store]:
    monkeypatch.setattr(Owner, "is_gone", lambda _self: True)
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as opened:
        yield opened


@pytest.fixture
def june(tmp_path: Path) -> Campaign:
    return from_folder(write_case(tmp_path / "june", "june"))


def repeats() -> CampaignPlan:
    """Three helices in one set-up, and a diagonal's in four others."""
    plan = next_plan(
        ["longer_session", "laser_diagonals"], machine_from_doc(MACHINE), [run_of(RUN)], name=("next1", "n1"), max_feed_mm_min=6000.0,
        about=Localization(runs=("r07",)),
    ).plan  # fmt: skip
    assert plan is not None
    return plan


class Played:
    """An addition of which some runs were measured."""

    def __init__(self, store: Store, june: Campaign) -> None:
        self.store, self.june = store, june
        self.number = store.campaigns.add(
            store.machines.add("VMC-1", MACHINE), "next1", {"continues": find_addition(store, june, repeats()).link}
        )

    def run(self, label: str, *, complete: bool = True) -> None:
        number = self.store.runs.start(self.number, label, "ballbar_helix", "identify", {})
        if complete:
            self.store.runs.finish(number, "complete", "", {})

    def left(self) -> tuple[TestPlan, ...]:
        found: LiveAddition = find_addition(self.store, self.june, repeats())
        return () if found.remaining is None else found.remaining.tests


@pytest.fixture
def played(store: Store, june: Campaign) -> Played:
    return Played(store, june)


def check_mounted_anew(tests: tuple[TestPlan, ...], suffix: str) -> None:
    """Cleared away and mounted before the machine moves with a bar; other names for the runs and for the cup."""
    first = tests[0]
    assert isinstance(first.steps[0], Unmount)  # asked before anything moves
    kinds = [type(s) for s in first.steps]
    assert kinds[:3] == [Unmount, MoveTo, MountBar]
    assert set(kinds[3:-1]) == {MoveTo}  # over the pole to the start
    assert kinds[-1] is RecordPath
    assert [t.label for t in tests[:3]] == [f"{label}{suffix}" for label in LABELS]
    assert {t.setup_id for t in tests[:3]} == {f"n1-late{suffix}"}
    assert [t.mounts for t in tests[:3]] == [True, False, False]
    assert not any(isinstance(t.steps[0], Unmount) for t in tests[1:])


def test_what_was_not_begun_is_measured_as_planned(played: Played) -> None:
    assert played.left() == repeats().tests


@pytest.mark.parametrize(
    "runs",
    [
        [("n1-late1", False)],  # killed in the test that mounts
        [("n1-late1", True)],  # between two tests
        [("n1-late1", True), ("n1-late2", False)],  # in the middle of the second
        [("n1-late1", True), ("n1-late2", True), ("n1-late3", False)],
    ],
)
def test_a_set_up_that_was_broken_off_is_repeated_from_its_mounting_on(played: Played, runs: list[tuple[str, bool]]) -> None:
    for label, complete in runs:
        played.run(label, complete=complete)
    check_mounted_anew(played.left(), "-2")
    assert len(played.left()) == len(repeats().tests)
    played.run("n1-late1-2")
    played.run("n1-late2-2", complete=False)
    check_mounted_anew(played.left(), "-3")


def test_a_set_up_that_was_completed_is_not_repeated_and_the_next_one_begins_cleared(played: Played) -> None:
    for label in LABELS:
        played.run(label)
    later = repeats().tests[3:]
    left = played.left()
    assert [t.label for t in left] == [t.label for t in later]
    assert left[0].steps == (Unmount(), *later[0].steps)
    for label in [f"{label}-2" for label in LABELS] + [t.label for t in later]:
        played.run(label)
    assert played.left() == ()


def test_a_run_that_is_left_out_still_tells_when_its_set_up_was_mounted(tmp_path: Path, store: Store) -> None:
    folder = write_case(tmp_path / "c1")
    for name in ("r01", "r02"):
        run = json.loads((folder / f"{name}.json").read_text())
        run["setup"] |= {"setup_id": "S"}
        (folder / f"{name}.json").write_text(json.dumps(run))
    whole = from_folder(folder)
    mounted_s = whole.runs[0].setup.t_set_s
    less = whole.without(["r01"])
    case = case_of(less.doc, less.site.machine, less.runs)
    assert {r.path.label: r.path.t_set_s for r in case.runs}["r02"] == mounted_s == 540.0
    assert set(ensure_stored(store, less)) == {"r01", "r02", "r03", "r04"}
    assert set(ensure_stored(store, less)) == {"r01", "r02", "r03", "r04"}  # found there again, and the same
