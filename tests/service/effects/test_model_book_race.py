"""Two that write into one model book at once: one enters, the other is told, and nothing is half written. SQLite file and PostgreSQL."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import event

from abbe.service import cli
from abbe.service.campaign_data.campaign_folder import from_folder
from abbe.service.discovery.discover import DiscoveryJob, discover, prepare
from abbe.service.discovery.discovery_store import StoredJournal, journal_of
from abbe.service.domain.document import Doc
from abbe.service.domain.progress import ignore_progress
from abbe.service.domain.results import NewVersion
from abbe.service.effects.effect_catalogue import catalogue
from abbe.service.effects.model_book import current, revert
from abbe.service.errors import ModelMovedOn
from abbe.service.storage.store import Store
from tests.patience import within
from tests.service.discovery.discovery_bench import Search, write_case

NAME = "VMC-1"
ALL = ["FITTED", "SUSPICIOUS", "PROPOSED", "TESTING", "EXPLAINED"]


@pytest.fixture
def pair(url: str) -> Iterator[tuple[Store, Store]]:
    """Two connections, each with its own writer."""
    with Store.open(url) as one, Store.open(url) as other:
        yield one, other


def job_of(folder: Path, store: Store) -> DiscoveryJob:
    return prepare(from_folder(folder), catalogue(), current(store, NAME))


def states_of(store: Store, journal: StoredJournal) -> list[str]:
    return [s.state for s in store.discoveries.steps(journal.id or 0)]


def version(after: int | None, why: str = "by a test") -> NewVersion:
    doc: Doc = {"why": why, "effects": [], "gone": [], "machine_digest": "another", "parent": after}
    return NewVersion(NAME, after, doc)


def test_the_later_of_two_discoveries_is_not_put_on_top_of_what_it_has_not_seen(tmp_path: Path, pair: tuple[Store, Store]) -> None:
    june, july = write_case(tmp_path / "june", "june"), write_case(tmp_path / "july", "july", width_mm=9e-3)
    jobs = [job_of(folder, store) for folder, store in zip((june, july), pair, strict=True)]
    first, second = (journal_of(store, job) for store, job in zip(pair, jobs, strict=True))
    discover(jobs[0], first, Search(), ignore_progress)
    with pytest.raises(ModelMovedOn) as told:
        discover(jobs[1], second, Search(width_um=9.0), ignore_progress)
    assert told.value.code == "DIS-004"
    assert "machine 'VMC-1' has model version 1 now, but the new version was made without any: nothing was added" in str(told.value)
    assert told.value.remedy.startswith("run the same command again: it searches anew with the present model")
    one = pair[0]
    assert [(m.version, m.discovery_id) for m in one.models.all(NAME)] == [(1, first.id)]
    assert states_of(one, second) == ALL[:-1]  # the end and the version: both or none
    kept = StoredJournal(one, second.id or 0, NAME).finding
    assert kept is not None
    assert kept.effects[0].strength == 9.0

    search = Search(width_um=1.0)
    again = job_of(july, pair[1])
    assert again.known == ("backlash:X",)  # what the first one found is taken out now
    journal = journal_of(pair[1], again)
    assert journal.id not in {first.id, second.id}
    discover(again, journal, search, ignore_progress)
    assert (search.calls, journal.version) == (1, 2)
    newest = current(one, NAME)
    assert newest is not None
    assert newest.book.parent == 1
    assert [e.strength for e in newest.book.effects] == [8.0, 1.0]


def test_both_have_looked_before_either_writes(pair: tuple[Store, Store]) -> None:
    """On PostgreSQL both see an empty book, and the constraint decides; SQLite lets the second one look only after the first."""
    barrier = threading.Barrier(2)
    ids = []
    for number, store in enumerate(pair):
        campaign = store.campaigns.add(store.machines.add(NAME, {}), f"c{number}", {})
        ids.append(store.discoveries.add(campaign, "d", {"model_version": None}))

        def wait(_c: Any, _k: Any, statement: str, *_rest: Any) -> None:
            if statement.startswith("INSERT INTO machine_models"):
                with suppress(threading.BrokenBarrierError):
                    barrier.wait(0.5)

        event.listen(store.engine, "before_cursor_execute", wait)  # between the look and the write there is no other door
    ends: dict[int, int | ModelMovedOn | None] = {}

    def enter(store: Store, discovery_id: int) -> None:
        try:
            ends[discovery_id] = store.discoveries.add_step(discovery_id, 0, "EXPLAINED", {}, version(None))
        except ModelMovedOn as moved:
            ends[discovery_id] = moved

    threads = [threading.Thread(target=enter, args=words) for words in zip(pair, ids, strict=True)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20)
    winners = [k for k, v in ends.items() if v == 1]
    assert len(winners) == 1
    (loser,) = set(ids) - set(winners)
    moved = ends[loser]
    assert isinstance(moved, ModelMovedOn)
    assert "has model version 1 now" in moved.detail
    assert [m.discovery_id for m in pair[0].models.all(NAME)] == winners
    assert [len(pair[0].discoveries.steps(k)) for k in (winners[0], loser)] == [1, 0]


def test_a_version_is_added_to_the_current_one_and_to_no_other(pair: tuple[Store, Store]) -> None:
    one, other = pair
    with pytest.raises(ModelMovedOn, match="machine 'VMC-1' has no model now, but the new version was made on version 1"):
        one.models.add(version(1))
    assert [store.models.add(version(after)) for store, after in ((one, None), (other, 1), (one, 2))] == [1, 2, 3]
    for after in (None, 1, 2, 4):
        with pytest.raises(ModelMovedOn, match="has model version 3 now"):
            other.models.add(version(after))
    assert [m.version for m in one.models.all()] == [1, 2, 3]
    assert one.models.add(NewVersion("another machine", None, {})) == 1


RACER = """
import sys
from abbe.service.errors import ModelMovedOn
from abbe.service.domain.results import NewVersion
from abbe.service.storage.store import Store

with Store.open(sys.argv[1]) as store:
    print("ready", flush=True)
    sys.stdin.readline()
    for after in (None, *range(1, 20)):
        try:
            store.models.add(NewVersion("VMC-1", after, {"by": sys.argv[2]}))
            print("won", flush=True)
        except ModelMovedOn as moved:
            print(moved.code, flush=True)
"""


def test_two_processes_race_twenty_times(url: str) -> None:
    Store.open(url).close()
    words = [sys.executable, "-c", RACER, url]
    env = os.environ | {"PYTHONPATH": os.getcwd()}
    racers = [
        subprocess.Popen([*words, name], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env)
        for name in "ab"
    ]
    for racer in racers:
        assert racer.stdout is not None
        assert racer.stdout.readline() == "ready\n"
    for racer in racers:
        assert racer.stdin is not None
        racer.stdin.write("go\n")
        racer.stdin.flush()
    said = [racer.communicate(timeout=within(60)) for racer in racers]
    ends = [out.split() for out, _ in said]
    assert [len(e) for e in ends] == [20, 20], said
    with Store.open(url) as store:
        found = store.models.all(NAME)
    assert [m.version for m in found] == list(range(1, len(found) + 1))
    assert [sum(m.doc["by"] == name for m in found) for name in "ab"] == [e.count("won") for e in ends]
    assert {word for e in ends for word in e} <= {"won", "DIS-004"}
    assert sum(e.count("won") for e in ends) >= 1


def test_a_version_that_comes_while_a_person_goes_back_is_not_lost(pair: tuple[Store, Store], monkeypatch: pytest.MonkeyPatch) -> None:
    one, other = pair
    one.models.add(version(None))
    one.models.add(version(1))
    write = one.models.add

    def late(model: NewVersion, discovery_id: int | None = None) -> int:
        other.models.add(version(2, "a discovery's"))
        return write(model, discovery_id)

    monkeypatch.setattr(one.models, "add", late)
    with pytest.raises(ModelMovedOn, match="has model version 3 now, but the new version was made on version 2: nothing was added"):
        revert(one, NAME, 1)
    assert [m.doc["why"] for m in other.models.all(NAME)] == ["by a test", "by a test", "a discovery's"]
    monkeypatch.undo()
    assert revert(one, NAME, 1) == 4


def test_the_command_says_it_in_one_line(tmp_path: Path, url: str, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    folder = write_case(tmp_path / "june", "june")

    def search(*words: Any) -> Any:
        with Store.open(url) as other:
            other.models.add(version(None))
        return Search()(*words)

    monkeypatch.setattr("abbe.service.discovery.discover.search", search)
    assert cli.run(["discover", str(folder), "--db", url]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error")]
    assert len(lines) == 1
    assert lines[0].startswith("error DIS-004: discovery 1: machine 'VMC-1' has model version 1 now")
    assert lines[0].endswith("the finding stays in discovery 1")


def test_a_book_of_another_geometry_is_not_used_and_yet_it_is_what_a_version_comes_after(tmp_path: Path, pair: tuple[Store, Store]) -> None:
    store = pair[0]
    store.models.add(version(None))
    folder, search = write_case(tmp_path / "june", "june"), Search()
    job = job_of(folder, store)
    assert (job.base, job.expected_version) == (None, 1)
    journal = journal_of(store, job)
    assert journal_of(store, job_of(folder, store)).id == journal.id  # begun, and gone on with
    discover(job, journal, search, ignore_progress)
    assert journal.version == 2
    again = job_of(folder, store)
    discover(again, journal_of(store, again), search, ignore_progress)
    assert search.calls == 1
