"""Several services write to one database at once: nothing is mixed, and one list tells what each of them does."""

from __future__ import annotations

import asyncio
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import fields, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from abbe.service.audit.book import AuditBook
from abbe.service.cli import run
from abbe.service.domain.measured import Owner, this_process
from abbe.service.domain.schedule import Schedule
from abbe.service.domain.service_records import SILENT_AFTER, AuditEvent, HeartbeatRecord
from abbe.service.queries.fleet import HEADINGS, MachineStatus, fleet, machine_statuses, row, state_of
from abbe.service.scheduler.heartbeat import Heartbeat
from abbe.service.storage.store import Store
from tests.experiments.bench.history_case import START, History, build
from tests.service.core.fakes import FakeClock

CHILD = Path(__file__).parent / "checking_child.py"
CHECKS = 12
NOW = datetime(2026, 11, 22, 9, tzinfo=UTC)


def test_two_services_at_once_are_not_mixed(url: str) -> None:
    """Each with its timetable at the same seconds, as plants have it: slots, campaigns, runs and checks of one name in each."""
    Store.open(url).close()
    names = ["mill-1", "lathe-3"]
    with ExitStack() as stack:
        children = [
            stack.enter_context(
                subprocess.Popen([sys.executable, CHILD, url, name, str(CHECKS)], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
            )
            for name in names
        ]
        for child in children:
            assert child.stdout is not None
            assert child.stdout.readline() == b"ready\n"
        for child in children:
            child.communicate(b"go\n", timeout=60)
        assert [child.returncode for child in children] == [0, 0]
    with Store.open(url) as store:
        for name in names:
            checks = store.verifications.of_machine(name)
            assert len(checks) == CHECKS
            assert {(one.doc["machine"], one.doc["values"]["body_diagonal_um"]) for one in checks} == {(name, float(len(name)))}
            for one in checks:
                campaign = store.campaigns.find(one.doc["campaign"])
                assert campaign.id == one.campaign_id
                assert store.machines.get(campaign.machine_id).name == name
                assert [r.start_doc for r in store.runs.all(campaign.id)] == [{"of": name}]
            assert {slot.state for slot in store.slots.latest(f"{name}/quick")} == {"done: pass"}
            assert len(store.slots.latest(f"{name}/quick")) == CHECKS
        assert sorted(store.heartbeats.all()) == store.machines.names() == sorted(names)
        assert {line.machine: line.state for line in fleet(store, datetime.now(UTC))} == dict.fromkeys(
            names, "not running"
        )  # they have ended


def test_the_list_of_a_history(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    build(url, History(machines=3, days=30, checks_a_day=1, runs=90, chunks=False))
    now = datetime.now(UTC)
    due = [
        {"schedule": name, "recipe": "quick-check", "due_utc": (now + timedelta(hours=h)).isoformat()} for name, h in (("b", 7), ("a", 2))
    ]
    with Store.open(url) as store:
        store.heartbeats.put("mill-1", {"state": "waiting", "due": due})
        store.heartbeats.put("mill-2", {"state": "waiting", "due": []})
        store.heartbeats.put("mill-2", {"state": "measuring", "due": []})
        store.heartbeats.put("new-4", {"state": "waiting", "due": []})
        one, two, three, new = fleet(store, now)
        standing = machine_statuses(store, now)
    assert standing == [
        MachineStatus(**{field.name: getattr(line, field.name) for field in fields(MachineStatus)}) for line in (one, two, three, new)
    ]
    assert (one.state, one.verdict, one.next_due_utc, one.next_recipe) == ("waiting", "pass", due[1]["due_utc"], "quick-check")
    assert [(f.name, f.expanded, f.limit) for f in one.figures] == [("body_diagonal_um", 1.1, 20.0), ("helix_rms_um", 0.2, 5.0)]
    assert one.check_utc == (START + timedelta(days=29)).isoformat()
    assert (two.state, two.next_due_utc, one.limit_days, one.drifting) == ("measuring", "", None, ())
    assert (three.state, three.drifting, three.limit_figure) == ("no service", ("body_diagonal_um",), "body_diagonal_um")
    assert three.limit_days is not None
    days, low, high = three.limit_days
    true_days = 40.0 - 29.0  # from 10 um by 0.25 um a day to 20 um
    assert low < true_days < high
    assert low < days < high
    assert (new.state, new.verdict, new.figures, row(new)[-1]) == ("waiting", "", (), "")
    assert run(["fleet", "--db", url]) == 0
    out = capsys.readouterr().out
    assert [heading in out for heading in HEADINGS] == [True] * len(HEADINGS)
    assert [name in out for name in ("mill-1", "mill-2", "mill-3", "new-4")] == [True] * 4
    assert run(["fleet", "--db", url, "--json"]) == 0
    doc = json.loads(capsys.readouterr().out)
    assert [m["state"] for m in doc["machines"]] == ["waiting", "measuring", "no service", "waiting"]
    assert doc["machines"][2]["days_until_limit"] == pytest.approx(days, rel=1e-6)
    assert doc["machines"][0]["days_until_limit"] is None


def test_computers_with_one_key_prove_one_audit(postgres: Callable[[], str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder stands for a computer: each keeps the heads of its own records."""
    url, books = postgres(), {}
    with Store.open(url) as store:
        for name in ("pc-1", "pc-2", "pc-3"):
            monkeypatch.setenv("ABBE_AUDIT_FOLDER", str(tmp_path / name))
            books[name] = AuditBook(store, url)
        books["pc-1"].write(AuditEvent(who="os:a@pc-1", action="abbe serve", target="mill-1", outcome="begun"))
        shutil.copy(books["pc-1"].key_file, books["pc-2"].key_file)
        for k in range(4):
            books[f"pc-{1 + k % 2}"].write(AuditEvent(who="os:a@pc", action="abbe measure", target=f"{k}", outcome="done"))
        assert [books[name].verify() for name in ("pc-1", "pc-2")] == [[], []]
        books["pc-3"].write(
            AuditEvent(who="os:a@pc-3", action="abbe serve", target="mill-3", outcome="begun")
        )  # without the key of the others
        (fault,) = books["pc-1"].verify()
        assert fault.startswith("record 6 is sealed with another key (")


def test_a_service_that_is_gone_or_silent_is_not_running() -> None:
    said = HeartbeatRecord("m", {"state": "waiting"}, NOW.isoformat(), this_process())
    assert state_of(None, NOW) == "no service"
    assert state_of(said, NOW) == "waiting"
    assert state_of(said, NOW + SILENT_AFTER + timedelta(seconds=1)) == "not running"
    elsewhere = replace(said, owner=Owner("another-pc", 1, "boot/1"))
    assert state_of(elsewhere, NOW + SILENT_AFTER) == "waiting"
    assert state_of(replace(said, owner=replace(this_process(), start="killed")), NOW) == "not running"


def test_no_database_and_an_empty_one(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["fleet", "--db", "sqlite:///none.sqlite3"]) == 2
    assert capsys.readouterr().err.startswith("error STO-001: there is no database none.sqlite3")
    assert not (tmp_path / "none.sqlite3").exists()
    Store.open("sqlite:///new.sqlite3").close()
    assert run(["fleet", "--db", "sqlite:///new.sqlite3"]) == 0
    assert "no machine is in this database yet" in capsys.readouterr().out


async def test_a_station_says_every_change_and_goes_on_when_the_database_does_not(tmp_path: Path) -> None:
    schedule = Schedule("daily", "0 5 * * *", "UTC", "quick-check")
    clock = FakeClock(NOW)
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        seen: asyncio.Queue[str] = asyncio.Queue()
        fails = [False]

        class Desk:
            def put(self, machine: str, doc: dict) -> None:
                try:
                    if fails[0]:
                        store.runs.find("none")  # a real StoreError
                    store.heartbeats.put(machine, doc)
                finally:  # not before: the test looks into the database, or lets it fail, as soon as it hears of this
                    loop.call_soon_threadsafe(seen.put_nowait, doc["state"])

        loop = asyncio.get_running_loop()
        heartbeat = Heartbeat("mill-1", "0", Desk(), lambda: [(schedule, NOW + timedelta(hours=1))], clock)
        task = asyncio.create_task(heartbeat.run())
        assert await seen.get() == "waiting"
        fails[0] = True
        heartbeat.job_started(schedule, NOW)
        assert await seen.get() == "measuring"
        fails[0] = False
        heartbeat.job_ended(None)
        assert await seen.get() == "waiting"
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        (line,) = fleet(store, datetime.now(UTC))
        assert (line.machine, line.next_recipe) == ("mill-1", "quick-check")
