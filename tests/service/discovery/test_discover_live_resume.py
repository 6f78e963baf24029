"""`abbe discover --live` ended anywhere: the same command goes on there, measures nothing twice and searches nothing twice.

The process is ended in thought after each of its writes, one after the other: what a kill leaves behind is what was written.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import pickle
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import pytest

from abbe.drivers.api import Condition
from abbe.models.discovery.answer import Discovery, NextTest
from abbe.service import cli
from abbe.service.campaign_data import campaign_checks
from abbe.service.discovery import experiment_recipes
from abbe.service.discovery.discover_live import addition_count
from abbe.service.domain.measured import Owner
from abbe.service.domain.results import NewVersion
from abbe.service.errors import MeasurementFault
from abbe.service.runs.chunks import JSON_CODEC, encode_json
from abbe.service.runs.columns import pack_columns
from abbe.service.storage.repositories.measured import Campaigns, Chunks, Runs
from abbe.service.storage.repositories.results import Discoveries
from abbe.service.storage.store import Store
from tests.pretended_status import READY, controller_status
from tests.service.discovery.discovery_bench import MACHINE, Search, circle, write_case

LONG = os.environ.get("ABBE_TEST_LONG") == "1"
WRITES = ((Campaigns, "add"), (Runs, "start"), (Chunks, "append"), (Runs, "finish"), (Discoveries, "add"), (Discoveries, "add_step"))
OLD = ("r01", "r02", "r03", "r04")
ROUND_1, ROUND_2 = ("n1-feed", "n1-late"), ("n2-back",)
BOOT = 77


class Ended(BaseException):
    """The process is gone."""


class Asks(Search):
    """Proposes two runs, then one, then nothing; what it finds tells how many runs it has seen. Remembers what it was asked."""

    def __init__(self) -> None:
        super().__init__()
        self.asked: list[tuple[str, ...]] = []
        self.adds: dict[int, tuple[str, ...]] = {4: ("second_feed", "longer_session"), 6: ("opposite_direction",)}

    def __call__(self, case: Any, effects: Any, progress: Any) -> Discovery:
        labels = tuple(r.path.label for r in case.runs)
        self.asked.append(labels)
        self.width_um = 7.0 + 0.1 * len(labels)
        adds = self.adds.get(len(labels))
        test = None if adds is None else NextTest(adds, ("backlash:X", "lateral_play:EYX"), 4.2, 12.0, "")
        return dataclasses.replace(super().__call__(case, effects, progress), next_test=test)


@cache
def june() -> bytes:
    """A database into which the first campaign was imported."""
    with TemporaryDirectory() as folder:
        files = write_case(Path(folder) / "files", "june")
        doc = json.loads((files / "campaign.json").read_text()) | {"ctrl0_us": 0, "boot_id": BOOT}
        (files / "campaign.json").write_text(json.dumps(doc))
        assert cli.run(["import", str(files), "--db", f"sqlite:///{folder}/abbe.sqlite3"]) == 0
        return (Path(folder) / "abbe.sqlite3").read_bytes()


def once(compute: Callable[..., Any]) -> Callable[..., Any]:
    """The same readings and paths come again in every try: what is computed of them alone is computed once."""
    found: dict[bytes, Any] = {}

    def call(*given: Any) -> Any:
        key = hashlib.sha256(pickle.dumps(given)).digest()
        if key not in found:
            found[key] = compute(*given)
        return found[key]

    return call


@pytest.fixture(scope="module", autouse=True)
def _computed_once() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(campaign_checks, "suspects", once(campaign_checks.suspects))
        patch.setattr(experiment_recipes, "dry_run_campaign", once(experiment_recipes.dry_run_campaign))
        yield


class Bench:
    """The command on a machine that is played here, and what happened to it: ``measured``: labels, in order; ``search``: what was asked."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.url = f"sqlite:///{folder / 'abbe.sqlite3'}"
        self.measured: list[str] = []
        self.accepting: list[bool] = []
        self.search = Asks()
        self.boot, self.writes = BOOT, 0
        self.now_s, self.conditions = 7000.0, READY
        self.left: int | None = None
        self._folder, self._patch = folder, monkeypatch
        self._file()
        monkeypatch.setattr("abbe.service.discovery.discover.search", self.search)
        monkeypatch.setattr("abbe.service.cli.measure.ready_session", self._session)
        monkeypatch.setattr("abbe.service.campaigns.measure.measure_test", self._measure_test)
        for name in ("discovery.discover_live", "campaigns.measure"):
            monkeypatch.setattr(f"abbe.service.{name}.check_devices", self._answer)
        monkeypatch.setattr(Owner, "is_gone", lambda _self: True)
        for repository, name in WRITES:
            monkeypatch.setattr(repository, name, self._counted(getattr(repository, name)))

    def _file(self) -> None:
        stroke = [f"{a} = {json.dumps(v)}" for a, v in MACHINE["stroke_mm"].items()]
        pivots = [f"{a} = {json.dumps(v)}" for a, v in MACHINE["pivots_mm"].items()]
        head = ['name = "VMC-1"', f'chain = "{MACHINE["chain"]}"', "[stroke_mm]", *stroke, "[pivots_mm]", *pivots, "[store]"]
        (self._folder / "machine.toml").write_text("\n".join([*head, f'url = "{self.url}"']) + "\n")
        (self._folder / "abbe.sqlite3").write_bytes(june())

    def _counted(self, write: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **more: Any) -> Any:
            done = write(*args, **more)
            self.writes += 1
            if self.left is not None:
                self.left -= 1
                if self.left == 0:
                    raise Ended
            return done

        return call

    @asynccontextmanager
    async def _session(self, _store: Store, _site: Any, *, accept_table: bool) -> AsyncIterator[Any]:
        self.accepting.append(accept_table)

        async def status() -> Any:
            return controller_status(self.conditions, ctrl_us=round(1e6 * self.now_s) + 1_000_000 * len(self.measured))

        async def comp_status() -> Any:
            return SimpleNamespace(boot_id=self.boot, bank_crc=(1, 2), active_bank=0, gen=1)

        async def abort() -> None:
            """A hold that a killed process may have left is taken away; nothing moves here."""

        yield SimpleNamespace(ballbar=None, laser=None, controller=SimpleNamespace(status=status, comp_status=comp_status, abort=abort))

    async def _answer(self, *_: Any, air: bool) -> None:
        """No device is played here, so none is asked."""

    async def _measure_test(self, _session: Any, store: Store, _site: Any, campaign: Any, test: Any, *_rest: Any) -> int:
        number = 5 + len(self.measured)
        self.measured.append(test.label)
        name = store.campaigns.find(campaign.id).name
        run = circle(number, "identify", name) | {"run_id": test.label}
        run["setup"] = run["setup"] | {"setup_id": test.label}
        payload = encode_json(pack_columns(run["columns"]))
        run_id = await store.write(store.runs.start, campaign.id, test.label, run["test"], "identify", {"imported": run})
        await store.write(store.chunks.append, run_id, "columns", 0, 120, JSON_CODEC, payload, 0.0, 0.0, 0, 0)
        await store.write(store.runs.finish, run_id, "complete", "", {})
        return int(run_id)

    def live(self, end_after: int | None = None, campaign: str = "june", *more: str) -> int | None:
        """The command; None: it was ended after so many writes."""
        self.left, self.writes = end_after, 0
        try:
            return cli.run(["discover", campaign, "--machine", str(self._folder / "machine.toml"), "--live", *more])
        except Ended:
            return None
        finally:
            self.left = None

    def stored(self) -> dict[str, Any]:
        """What is in the database and must not depend on where the command was ended."""
        with Store.open(self.url) as store:
            book = store.models.all("VMC-1")
            runs = [r for c in store.campaigns.all() for r in store.runs.all(c.id)]
            return {
                "campaigns": [c.name.split()[0] for c in store.campaigns.all()],
                "complete": sorted(r.label.removesuffix("-2") for r in runs if r.visible_status == "complete"),
                "states": [[s.state for s in store.discoveries.steps(d.id)] for d in store.discoveries.all()],
                "started": [(d.doc["model_version"], d.doc["after"], d.doc["continues"]) for d in store.discoveries.all()],
                "book": [(m.version, m.discovery_id, [round(e["strength"], 6) for e in m.doc["effects"]]) for m in book],
            }


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    monkeypatch.chdir(tmp_path)
    return Bench(tmp_path, monkeypatch)


STATES = ["FITTED", "SUSPICIOUS", "PROPOSED", "TESTING", "EXPLAINED"]
WHOLE = {
    "campaigns": ["june", "next1", "next2"],
    "complete": sorted((*OLD, *ROUND_1, *ROUND_2)),
    "states": [STATES] * 3,
    "started": [(None, None, None), (None, 1, 1), (None, 2, 2)],  # all from readings with nothing taken out, each after the last
    "book": [(1, 1, [7.4]), (2, 2, [7.6]), (3, 3, [7.7])],  # each replaces the last: the readings of the first are in all of them
}
SEARCHES = [4, 6, 7]
COUNT = 2 * 6 + (1 + 2 * 3) + 6 + (1 + 3)
"""Writes of an undisturbed command: three discoveries of six, two campaigns with two runs and one of three."""


def test_undisturbed_it_measures_twice_and_done_again_it_does_nothing(bench: Bench, capsys: Any) -> None:
    assert bench.live() == 0
    assert bench.writes == COUNT
    assert bench.stored() == WHOLE
    assert bench.measured == [*ROUND_1, *ROUND_2]
    assert [len(a) for a in bench.search.asked] == SEARCHES
    capsys.readouterr()
    assert bench.live() == 0
    assert bench.writes == 0
    assert len(bench.search.asked) == 3
    assert bench.stored() == WHOLE
    said = capsys.readouterr().out
    assert ": 2 of 2 runs are measured" in said
    assert ": 1 of 1 runs are measured" in said
    assert "stored: discovery 3, EXPLAINED, model version 3 of VMC-1" in said


def test_a_person_s_word_for_the_table_in_force_is_not_said_again_in_later_rounds(bench: Bench) -> None:
    assert bench.live(None, "june", "--accept-table") == 0
    assert bench.measured == [*ROUND_1, *ROUND_2]
    assert bench.accepting == [True, False]


# First discovery opened, searched, ended; added campaign begun; its first run started, read; its last one complete; end. What comes
# between them is of the same kinds, in the first round or the second: ABBE_TEST_LONG=1 plays all.
SOME = (1, 3, 6, 7, 8, 9, 13, 16, COUNT)


@pytest.mark.parametrize("end_after", range(1, COUNT + 1) if LONG else SOME)
def test_ended_after_any_write_it_goes_on_there(bench: Bench, end_after: int) -> None:
    assert bench.live(end_after) is None
    assert bench.live() == 0
    assert bench.stored() == WHOLE
    assert [len(a) for a in bench.search.asked] == SEARCHES  # a finding is kept with the first state that follows from it
    again = [label for label in bench.measured if label.endswith("-2")]  # a run that was not completed, under a name of its own
    assert Counter(label.removesuffix("-2") for label in bench.measured) == Counter([*ROUND_1, *ROUND_2, *(a[:-2] for a in again)])
    lost = bench.writes - (COUNT - end_after)  # of such a run: that it was started, and perhaps its readings
    assert (len(again), lost) in {(0, 0), (1, 1), (1, 2)}


@pytest.mark.parametrize("number", [1, 2, 3] if LONG else [1, 2])
def test_ended_within_a_search_only_that_one_is_done_again(bench: Bench, number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    def doomed(*words: Any) -> Discovery:
        found = bench.search(*words)
        if len(bench.search.asked) == number:
            raise KeyboardInterrupt
        return found

    monkeypatch.setattr("abbe.service.discovery.discover.search", doomed)
    assert bench.live() == 130
    assert bench.live() == 0
    assert bench.stored() == WHOLE
    assert bench.measured == [*ROUND_1, *ROUND_2]
    assert [len(a) for a in bench.search.asked] == sorted([*SEARCHES, SEARCHES[number - 1]])


def test_what_is_left_needs_the_clock_of_the_first_runs_and_what_is_complete_needs_no_machine(bench: Bench, capsys: Any) -> None:
    ended_in_the_second_run = 6 + 1 + 3 + 1
    assert bench.live(ended_in_the_second_run) is None
    bench.boot += 1  # switched off and on
    assert bench.live() == 2
    assert "error SOL-003: campaign june was measured before the controller restarted, or on another controller" in capsys.readouterr().err
    assert bench.measured == [*ROUND_1]
    bench.boot -= 1
    assert bench.live(6 - 3 + 3) is None  # up to the second run's second try, and the state that follows
    bench.boot += 1
    assert bench.live() == 2  # the next round has to be measured, and cannot be
    with Store.open(bench.url) as store:
        assert len(store.discoveries.all()) == 2
        assert [s.state for s in store.discoveries.steps(2)] == STATES


def test_a_fault_of_one_run_keeps_the_others(bench: Bench, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    async def fails(_session: Any, store: Store, _site: Any, campaign: Any, test: Any, *rest: Any) -> int:
        if test.label != "n1-late":
            return await bench._measure_test(_session, store, _site, campaign, test, *rest)
        run_id = await store.write(store.runs.start, campaign.id, test.label, test.test, test.role, {})
        await store.write(store.runs.finish, run_id, "failed", "SEQ-003: the bar fell out", None)
        raise MeasurementFault("the bar fell out")

    with monkeypatch.context() as patch:
        patch.setattr("abbe.service.campaigns.measure.measure_test", fails)
        assert bench.live() == 2
    assert "error SEQ-003: the bar fell out" in capsys.readouterr().err
    assert bench.live() == 0
    assert bench.stored() == WHOLE
    assert bench.measured == ["n1-feed", "n1-late-2", "n2-back"]


def test_a_run_that_another_process_measures_is_left_to_it(bench: Bench, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    assert bench.live(6 + 1 + 1) is None
    monkeypatch.setattr(Owner, "is_gone", lambda _self: False)
    assert bench.live() == 2
    assert "error SEQ-002: run n1-feed of campaign next1" in capsys.readouterr().err


def test_a_machine_that_was_found_to_be_otherwise_meanwhile_is_searched_anew_and_not_measured_anew(bench: Bench, capsys: Any) -> None:
    assert bench.live(6 + 7 + 5) is None  # the second search stands at TESTING
    with Store.open(bench.url) as store:
        first = store.models.all("VMC-1")[0]
        store.models.add(NewVersion("VMC-1", 1, first.doc | {"effects": [], "why": "mended"}))
    assert bench.live() == 0
    assert bench.measured == [*ROUND_1, *ROUND_2]
    assert [len(a) for a in bench.search.asked] == [4, 6, *SEARCHES]
    told = bench.stored()
    assert told["started"] == [(None, None, None), (None, 1, 1), (2, 2, None), (2, 3, 3), (2, 4, 4)]
    assert [states[-1] for states in told["states"]] == ["EXPLAINED", "TESTING", *["EXPLAINED"] * 3]
    assert [v for v, _, _ in told["book"]] == [1, 2, 3, 4, 5]


def test_a_late_repeat_waits_until_it_is_late(bench: Bench, capsys: Any) -> None:
    bench.now_s = 6000.0  # the last reading is of 2437 s
    assert bench.live() == 0
    assert "too early for second_feed, longer_session: give the same command at " in capsys.readouterr().out
    assert bench.measured == []
    with Store.open(bench.url) as store:
        assert [c.name for c in store.campaigns.all()] == ["june"]
    bench.now_s = 6100.0
    assert bench.live() == 0
    assert bench.stored() == WHOLE


def test_nobody_is_asked_to_reach_into_a_machine_that_runs_a_path_to_its_end(bench: Bench, capsys: Any) -> None:
    bench.conditions = READY | Condition.MOVING
    assert bench.live() == 2
    assert "error SEQ-002: the machine is moving" in capsys.readouterr().err
    assert bench.measured == []


def test_an_addition_that_is_gone_on_with_alone_has_labels_of_its_own(bench: Bench) -> None:
    bench.search.adds = {4: ("second_feed",)}
    assert bench.live() == 0
    with Store.open(bench.url) as store:
        names = [c.name for c in store.campaigns.all()]
        assert [addition_count(store, n) for n in names] == [0, 1]
    bench.search.adds = {1: ("second_feed",)}
    assert bench.live(campaign=names[1]) == 0
    assert bench.measured == ["n1-feed", "n2-feed"]
    assert bench.search.asked[-1] == ("n1-feed", "n2-feed")
