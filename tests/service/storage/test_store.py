"""The store keeps what it is given, in order, exactly once, and says so when it cannot."""

from __future__ import annotations

import asyncio
import os
import signal
import sqlite3
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import pytest

from abbe.service.domain.measured import ImportedRun, process_start, this_process
from abbe.service.errors import StoreError
from abbe.service.secrets import mask_secrets
from abbe.service.storage import wal_is_safe
from abbe.service.storage.engine import resolve_url
from abbe.service.storage.store import Store


def append(store: Store, run_id: int, seq: int, payload: bytes = b"abc") -> None:
    store.chunks.append(run_id, "bar", seq, 3, "bar/1", payload, 1.5, 1.75, 10**12, 2**40)


def test_machine_is_stored_once_per_description(store: Store) -> None:
    first = store.machines.add("VMC-1", {"a": 1, "b": [1.5]})
    assert store.machines.add("VMC-1", {"b": [1.5], "a": 1}) == first
    assert store.machines.add("VMC-1", {"a": 2}) != first
    assert store.machines.get(first).doc == {"a": 1, "b": [1.5]}
    assert [one.id for one in store.machines.all()] == [first, first + 1]
    with pytest.raises(StoreError, match="no machine 99"):
        store.machines.get(99)


def test_campaign_is_found_by_name_and_id(store: Store, campaign_id: int) -> None:
    assert store.campaigns.find("c1") == store.campaigns.find(campaign_id) == store.campaigns.find(str(campaign_id))
    assert store.campaigns.find("c1").created_utc == "2026-11-21T03:34:00.000000Z"
    with pytest.raises(StoreError, match="already"):
        store.campaigns.add(1, "c1", {})
    with pytest.raises(StoreError, match="no campaign 'nope'"):
        store.campaigns.find("nope")


def test_a_campaign_name_of_digits_wins_over_an_id(store: Store, campaign_id: int) -> None:
    other = store.campaigns.add(1, str(campaign_id), {})
    assert store.campaigns.find(str(campaign_id)).id == other
    assert store.campaigns.find(campaign_id).id == campaign_id


def test_run_from_start_to_end(store: Store, campaign_id: int) -> None:
    run_id = store.runs.start(campaign_id, "r01", "ballbar_helix", "identify", {"rate_hz": 1000, "x": 0.1})
    append(store, run_id, 0)
    append(store, run_id, 1, b"\x00\xff" * 5000)
    running = store.runs.find("r01")
    assert (running.status, running.visible_status, running.end_doc, running.campaign) == ("running", "running", None, "c1")
    store.runs.finish(run_id, "complete", "", {"path_start_us": 2**50})
    done = store.runs.find(run_id)
    assert done.visible_status == "complete"
    assert done.end_doc == {"path_start_us": 2**50}
    assert done.start_doc == {"rate_hz": 1000, "x": 0.1}
    first, second = store.chunks.of_run(run_id, "bar")
    assert (first.payload, first.n, first.first_device_us, first.last_device_us, first.first_host_s) == (b"abc", 3, 10**12, 2**40, 1.5)
    assert second.payload == b"\x00\xff" * 5000
    assert store.chunks.of_run(run_id) == [first, second]
    assert store.chunks.of_run(run_id, "laser") == []


def test_closed_run_and_written_chunk_never_change(store: Store, campaign_id: int) -> None:
    run_id = store.runs.start(campaign_id, "r01", "ballbar_helix", "identify", {})
    append(store, run_id, 0)
    with pytest.raises(StoreError, match="never overwritten"):
        append(store, run_id, 0)
    store.runs.finish(run_id, "aborted", "e-stop", None)
    with pytest.raises(StoreError, match=r"closed \(aborted\)"):
        append(store, run_id, 1)
    with pytest.raises(StoreError, match=r"closed \(aborted\)"):
        store.runs.finish(run_id, "complete", "", {})
    with pytest.raises(StoreError, match="not one of"):
        store.runs.finish(run_id, "running", "", {})
    with pytest.raises(StoreError, match="no run 99"):
        append(store, 99, 0)
    with pytest.raises(StoreError, match="exists already"):
        store.runs.start(campaign_id, "r01", "ballbar_helix", "identify", {})
    assert store.runs.find(run_id).reason == "e-stop"


def test_run_label_of_two_campaigns_must_be_qualified(store: Store, campaign_id: int) -> None:
    other = store.campaigns.add(1, "c2", {})
    one = store.runs.start(campaign_id, "r01", "ballbar_helix", "identify", {})
    two = store.runs.start(other, "r01", "ballbar_helix", "identify", {})
    with pytest.raises(StoreError, match="c1/r01, c2/r01"):
        store.runs.find("r01")
    assert store.runs.find("c2/r01").id == two
    assert store.runs.find(str(one)).id == one
    assert [run.id for run in store.runs.all("c2")] == [two]
    assert [run.id for run in store.runs.all()] == [one, two]
    with pytest.raises(StoreError, match="no run 'r99'"):
        store.runs.find("r99")


def test_run_of_a_dead_process_is_incomplete(store: Store, campaign_id: int) -> None:
    run = store.runs.find(store.runs.start(campaign_id, "r01", "ballbar_helix", "identify", {}))
    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    alive = replace(run, owner=replace(run.owner, pid=child.pid, start=process_start(child.pid)))
    assert alive.visible_status == "running"
    child.communicate(b"\n")
    assert alive.visible_status == "incomplete"
    reused = replace(run, owner=replace(run.owner, start="other-boot/1"))
    assert reused.visible_status == "incomplete"
    elsewhere = replace(reused, owner=replace(reused.owner, host="another-computer"))
    assert elsewhere.visible_status == "running"
    assert replace(reused, status="complete").visible_status == "complete"


def test_killed_process_leaves_acknowledged_chunks_and_an_incomplete_run(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'abbe.sqlite3'}"
    program = f"""
import sys
from abbe.service.storage.store import Store
store = Store.open({url!r})
run = store.runs.start(store.campaigns.add(store.machines.add("m", {{}}), "c1", {{}}), "r01", "ballbar_helix", "identify", {{}})
for seq in range(100000):
    store.chunks.append(run, "bar", seq, 1, "bar/1", b"x" * 500, 0.0, 0.0, 0, 0)
    print(seq, flush=True)
"""
    child = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE)
    assert child.stdout is not None
    for _ in range(50):
        child.stdout.readline()
    child.send_signal(signal.SIGKILL)
    rest = child.stdout.read().splitlines()
    child.wait()
    child.stdout.close()
    acknowledged = int(rest[-1]) if rest else 49
    with Store.open(url) as store:
        run = store.runs.find("r01")
        assert run.visible_status == "incomplete"
        assert [chunk.seq for chunk in store.chunks.of_run(run.id, "bar")][: acknowledged + 1] == list(range(acknowledged + 1))


def test_damaged_chunk_is_named(file_store: Store, tmp_path: Path) -> None:
    campaign = file_store.campaigns.add(file_store.machines.add("m", {}), "c1", {})
    run_id = file_store.runs.start(campaign, "r07", "ballbar_helix", "identify", {})
    append(file_store, run_id, 0)
    append(file_store, run_id, 1)
    raw = sqlite3.connect(tmp_path / "abbe.sqlite3")
    raw.execute("UPDATE chunks SET payload = x'616264' WHERE seq = 1")
    raw.commit()
    raw.close()
    with pytest.raises(StoreError, match="run c1/r07, chunk 1 of channel 'bar'"):
        file_store.chunks.of_run(run_id, "bar")


def test_results_come_back(store: Store, campaign_id: int) -> None:
    solution = store.solutions.add(campaign_id, "rigid21", [1, 2], {"theta": [1e-6]})
    assert store.solutions.get(solution).run_ids == [1, 2]
    assert store.solutions.all(campaign_id) == store.solutions.all() == [store.solutions.get(solution)]
    table = store.tables.add(1, solution, b"\xab\xbe", 2**32 - 1, {"kind": 1})
    read_back = store.tables.add(1, None, b"", 0, {})
    assert (store.tables.get(table).image, store.tables.get(table).crc, store.tables.get(read_back).solution_id) == (
        b"\xab\xbe",
        2**32 - 1,
        None,
    )
    assert [one.id for one in store.tables.all(1)] == [table, read_back]
    first = store.verifications.add(1, campaign_id, "pass", {})
    second = store.verifications.add(1, None, "fail", {})
    assert [one.id for one in store.verifications.latest()] == [second, first]
    assert [one.id for one in store.verifications.latest(machine_id=1, limit=1)] == [second]
    with pytest.raises(StoreError, match=r"no solution 99 .*`abbe solve CAMPAIGN` stores one"):
        store.solutions.get(99)


def test_slot_is_claimed_by_one_only(store: Store) -> None:
    due = datetime(2026, 11, 21, 4, tzinfo=UTC)
    with ThreadPoolExecutor(8) as pool:
        assert sorted(pool.map(lambda _: store.slots.claim("nightly", due), range(16))) == [False] * 15 + [True]
    assert not store.slots.claim("nightly", due.astimezone(timezone(timedelta(hours=9))))
    assert not store.slots.claim("nightly", "2026-11-21T04:00:00Z")
    assert store.slots.claim("weekly", due)
    store.slots.finish("nightly", due, "done")
    with pytest.raises(StoreError, match="was not claimed"):
        store.slots.finish("monthly", due, "done")
    with pytest.raises(StoreError, match="no time zone"):
        store.slots.claim("nightly", due.replace(tzinfo=None))
    with pytest.raises(StoreError, match="ISO 8601"):
        store.slots.claim("nightly", "tomorrow")


def test_outbox_keeps_order_until_sent(store: Store) -> None:
    ids = [store.outbox.add("abbe/x", payload) for payload in (b"\x00", "ü", b"3")]
    assert [(one.id, one.payload) for one in store.outbox.pending()] == list(zip(ids, [b"\x00", "ü".encode(), b"3"], strict=True))
    store.outbox.done(ids[0])
    store.outbox.done(ids[0])
    assert [one.id for one in store.outbox.pending(limit=1)] == [ids[1]]


async def test_write_does_not_block_the_loop_and_survives_cancellation(store: Store, campaign_id: int) -> None:
    run_id = await store.write(store.runs.start, campaign_id, "r01", "ballbar_helix", "identify", {})
    release = threading.Event()
    blocker = store._submit(release.wait)
    waiting = asyncio.create_task(store.write(append, store, run_id, 0))
    await asyncio.sleep(0)
    waiting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await waiting
    release.set()
    await asyncio.wrap_future(blocker)
    await store.write(append, store, run_id, 1)
    assert [chunk.seq for chunk in await asyncio.to_thread(store.chunks.of_run, run_id, "bar")] == [0, 1]


def test_threads_write_at_the_same_time(store: Store, campaign_id: int) -> None:
    run_id = store.runs.start(campaign_id, "r01", "ballbar_helix", "identify", {})
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda seq: append(store, run_id, seq), range(40)))
    assert len(store.chunks.of_run(run_id)) == 40


def test_import_is_all_or_nothing(store: Store) -> None:
    run = ImportedRun("r01", "laser_linear", "identify", {}, 1, "json/1", b"x")
    with pytest.raises(StoreError, match="exists already"):
        store.runs.import_campaign(("m", {}), ("c9", {}), [run, run])
    assert store.campaigns.all() == store.machines.all() == store.runs.all() == []
    store.runs.import_campaign(("m", {}), ("c9", {}), [run])
    assert store.runs.find("c9/r01").visible_status == "complete"
    with pytest.raises(StoreError, match="already"):
        store.runs.import_campaign(("m", {}), ("c9", {}), [run])


def test_nan_in_a_document_is_refused(store: Store) -> None:
    with pytest.raises(StoreError, match="NaN or Infinity"):
        store.machines.add("m", {"a": float("nan")})


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("nonsense", "cannot be understood"),
        ("mysql://u:secret@h/x", "'mysql' is not supported"),
        ("sqlite:////no/such/folder/x.sqlite3", "folder /no/such/folder does not exist"),
        ("postgresql://u:secret@127.0.0.1:1/x", r"u:\*\*\*@127.0.0.1:1/x"),
    ],
)
def test_url_that_cannot_be_opened(url: str, message: str) -> None:
    with pytest.raises(StoreError, match=message) as caught:
        Store.open(url)
    assert "secret" not in str(caught.value)
    assert "\n" not in str(caught.value)


def test_file_that_is_no_database(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("not a database, but long enough to look like a file")
    with pytest.raises(StoreError, match="is not a SQLite database"):
        Store.open(f"sqlite:///{path}")
    assert path.read_text().startswith("not a database")
    with pytest.raises(StoreError, match="is a folder"):
        Store.open(f"sqlite:///{tmp_path}")


def test_closed_store_says_so(tmp_path: Path) -> None:
    store = Store.open(f"sqlite:///{tmp_path / 'x.sqlite3'}")
    store.close()
    store.close()
    with pytest.raises(StoreError, match="is closed"):
        store.machines.add("m", {})


def test_pragmas_of_every_connection(file_store: Store) -> None:
    with file_store.engine.connect() as connection:
        values = {
            name: connection.exec_driver_sql(f"PRAGMA {name}").scalar()
            for name in ("foreign_keys", "busy_timeout", "synchronous", "journal_mode")
        }
    assert values == {"foreign_keys": 1, "busy_timeout": 5000, "synchronous": 2, "journal_mode": "wal" if wal_is_safe() else "persist"}


@pytest.mark.parametrize(
    ("version", "safe"),
    [
        ("3.40.1", False),
        ("3.44.5", False),
        ("3.44.6", True),
        ("3.45.0", False),
        ("3.50.6", False),
        ("3.50.7", True),
        ("3.51.2", False),
        ("3.51.3", True),
        ("3.52.0", True),
    ],
)
def test_wal_only_where_its_bug_is_fixed(version: str, safe: bool) -> None:
    assert wal_is_safe(version) is safe


def test_relative_database_is_beside_the_machine_file(tmp_path: Path) -> None:
    assert resolve_url("sqlite:///abbe.sqlite3", tmp_path) == f"sqlite:///{tmp_path / 'abbe.sqlite3'}"
    for url in ("sqlite://", "sqlite:////abs/x.sqlite3", "postgresql://u:p@h/n"):
        assert resolve_url(url, tmp_path) == url


def test_secrets_are_masked() -> None:
    assert mask_secrets("cannot reach mqtt://me:pa:ss@host:1883 nor x") == "cannot reach mqtt://me:***@host:1883 nor x"
    assert mask_secrets("mqtt://host:1883") == "mqtt://host:1883"


def test_this_process_is_not_gone() -> None:
    me = this_process()
    assert me.pid == os.getpid()
    assert not me.is_gone()


def test_the_newest_runs_and_solutions_come_first_and_only_those_asked_for(store: Store, campaign_id: int) -> None:
    other = store.campaigns.add(store.machines.add("VMC-1", {"name": "VMC-1"}), "c2", {})
    for owner, label, test in ((campaign_id, "a", "laser_linear"), (other, "b", "ballbar_helix"), (campaign_id, "c", "laser_linear")):
        store.runs.finish(store.runs.start(owner, label, test, "identify", {}), "complete", "", None)
    store.runs.start(other, "d", "laser_linear", "identify", {})
    assert [r.label for r in store.runs.latest(3)] == ["d", "c", "b"]
    assert [r.label for r in store.runs.latest(9, campaign="c2")] == ["d", "b"]
    assert [r.label for r in store.runs.latest(9, test="laser_linear", status="complete")] == ["c", "a"]
    assert store.runs.latest(9, campaign="c3") == []
    for kind in ("joint", "levels", "joint"):
        store.solutions.add(campaign_id, kind, [1], {})
    assert [s.id for s in store.solutions.latest("joint", 9)] == [3, 1]
    assert [s.id for s in store.solutions.latest("joint", 1)] == [3]
