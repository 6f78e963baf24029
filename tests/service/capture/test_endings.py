"""How a recording ends when the disk, the database or the caller does not do what it should: nothing is deleted that only the file has."""

from __future__ import annotations

import asyncio
import errno
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
from sqlalchemy.exc import OperationalError

from abbe.service.capture import ingest as ingest_module
from abbe.service.capture import recorder as recorder_module
from abbe.service.capture.ingest import is_full
from abbe.service.capture.ledger import Drafter
from abbe.service.capture.recorder import CaptureRecorder, close_run, is_active, recording
from abbe.service.capture.recovery import ledger_of, read_segment, recover_segments
from abbe.service.capture.segment import RealFileIO
from abbe.service.capture.settings import CaptureSettings, segment_folder, segment_path
from abbe.service.clock import SystemClock
from abbe.service.domain.measured import ChunkRecord
from abbe.service.errors import AbbeError, CaptureFault, DiskFull, StoreError
from abbe.service.runs.chunks import decode_bar
from abbe.service.storage.repositories import measured as store_measured
from abbe.service.storage.store import Store
from tests.patience import within
from tests.service.capture.capture_bench import abandon, batch, new_run

SETTINGS = CaptureSettings(reserve_bytes=65536)


@pytest.fixture
def store(tmp_path: Path):
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as opened:
        yield opened


async def measured(store: Store, run_id: int, feed: Callable[[CaptureRecorder], None], **options) -> BaseException | None:
    """As a workflow measures a test: record, then close the run; gives the error that came out."""
    recorder, status, failure = None, "failed", None
    try:
        async with recording(store, run_id, SETTINGS, SystemClock(), **options) as recorder:
            feed(recorder)
        status = "complete"
    except (AbbeError, ZeroDivisionError) as error:
        failure = error
    await close_run(store, run_id, recorder, status, repr(failure), {} if recorder is None else recorder.doc())
    return failure


def seqs(store: Store, run_id: int) -> list[int]:
    return [sample.seq for chunk in store.chunks.of_run(run_id, "bar") for sample in decode_bar(chunk.payload)]


def give(recorder: CaptureRecorder) -> None:
    recorder.tap().take(batch(0, 50))


class FailingClose(RealFileIO):
    def close(self, handle: int) -> None:
        super().close(handle)
        raise OSError(errno.EIO, os.strerror(errno.EIO))


async def test_an_error_at_the_close_fails_the_run_and_loses_nothing(store: Store) -> None:
    failure = await measured(store, run_id := new_run(store), give, io=FailingClose())
    assert isinstance(failure, CaptureFault)
    assert store.runs.find(str(run_id)).status == "failed"
    assert seqs(store, run_id) == list(range(50))


async def test_a_defect_at_the_end_never_closes_a_run_that_the_database_lacks(store: Store, monkeypatch) -> None:
    monkeypatch.setattr(recorder_module, "CATCH_UP_S", 0.2)
    monkeypatch.setattr(ingest_module.Ingest, "_give", lambda self, records: threading.Event().wait(1.0))
    monkeypatch.setattr(recorder_module.CaptureLog, "close", lambda self, doc, cause: 1 / 0)
    failure = await measured(store, run_id := new_run(store), give)
    assert isinstance(failure, ZeroDivisionError)
    assert store.runs.find(str(run_id)).status == "running"
    assert segment_path(segment_folder(store.url, SETTINGS), run_id).exists()


async def test_numbers_that_went_back_while_the_disk_was_full_are_gaps_of_their_own_stream(store: Store) -> None:
    def feed(recorder: CaptureRecorder) -> None:
        recorder.tap().take(batch(0, 500))
        recorder.log.flush()
        recorder.log.error = DiskFull("full")
        recorder.tap().take(batch(0, 20))
        recorder.log.flush()

    failure = await measured(store, run_id := new_run(store), feed)
    assert isinstance(failure, DiskFull)
    ledger = ledger_of(store.chunks.of_run(run_id))
    assert [(gap.stream, gap.first, gap.last) for gap in ledger.gaps] == [(1, 0, 19)]
    assert store.runs.find(str(run_id)).status == "failed"


def test_a_gap_never_has_a_negative_count() -> None:
    drafter = Drafter(1, lambda: 0.0)
    drafter.drafts([(0, batch(0, 500))])
    assert drafter.lost("went back", 19, None).count == 0


class Hanging(RealFileIO):
    def __init__(self) -> None:
        self.hang, self.again = threading.Event(), threading.Event()

    def sync(self, handle: int) -> None:
        if self.hang.is_set():
            self.again.wait(within(30.0))
        super().sync(handle)


async def test_a_disk_that_hangs_at_the_close_leaves_run_and_file_to_the_next_start(store: Store, monkeypatch) -> None:
    monkeypatch.setattr(recorder_module, "HANG_S", 0.2)
    disk, seen = Hanging(), []

    def feed(recorder: CaptureRecorder) -> None:
        seen.append(recorder)
        give(recorder)
        recorder.log.flush()
        disk.hang.set()
        recorder.log.put((0, batch(50, 50)))

    failure = await measured(store, run_id := new_run(store), feed, io=disk)
    path = segment_path(segment_folder(store.url, SETTINGS), run_id)
    try:
        assert isinstance(failure, CaptureFault)
        assert "has not answered" in str(failure)
        assert (store.runs.find(str(run_id)).status, path.exists(), is_active(path)) == ("running", True, False)
        (told,) = recover_segments(store, SETTINGS)  # its thread may still write: the lock says so
        assert "still writes" in told.text
        assert store.runs.find(str(run_id)).status == "running"
    finally:
        disk.again.set()
        seen[0].log._thread.join(10)
    seen[0].log.segment.close()
    recover_segments(store, SETTINGS)
    assert seqs(store, run_id) == list(range(100))
    assert store.runs.find(str(run_id)).status == "interrupted"


async def test_a_disk_that_hangs_does_not_hold_the_tap_for_ever(store: Store, monkeypatch) -> None:
    monkeypatch.setattr(recorder_module, "HANG_S", 0.2)
    monkeypatch.setattr(recorder_module, "MAX_PENDING", 50)
    disk = Hanging()

    def feed(recorder: CaptureRecorder) -> None:
        give(recorder)
        recorder.log.flush()
        disk.hang.set()
        for first in range(50, 300, 50):
            recorder.log.put((0, batch(first, 50)))
        disk.again.set()
        recorder.log.flush()

    failure = await measured(store, run_id := new_run(store), feed, io=disk)
    assert "has not answered" in str(failure)
    ledger = ledger_of(store.chunks.of_run(run_id))
    assert (ledger.unaccounted(), ledger.stored + sum(gap.missing for gap in ledger.gaps)) == ([], 300)


async def test_a_run_is_registered_from_before_its_file_until_it_is_closed(store: Store) -> None:
    path = segment_path(segment_folder(store.url, SETTINGS), run_id := new_run(store))
    seen: list[bool] = []

    class Watching(RealFileIO):
        def create(self, path: Path) -> int:
            seen.append(is_active(path))
            return super().create(path)

    async with recording(store, run_id, SETTINGS, SystemClock(), io=Watching()) as recorder:
        pass
    assert recover_segments(store, SETTINGS) == []  # between the end of the recording and the end of the run
    assert store.runs.find(str(run_id)).status == "running"
    await close_run(store, run_id, recorder, "complete", "", recorder.doc())
    assert (seen, is_active(path), path.exists(), store.runs.find(str(run_id)).status) == ([True], False, False, "complete")


async def test_a_segment_that_somebody_writes_is_left_alone_although_its_run_looks_abandoned(store: Store) -> None:
    run_id = new_run(store)
    async with recording(store, run_id, SETTINGS, SystemClock()) as recorder:
        give(recorder)
        abandon(store, run_id)
        recorder.release()  # as another process sees it
        (told,) = recover_segments(store, SETTINGS)
        assert "still writes" in told.text
        assert store.runs.find(str(run_id)).status == "running"


async def test_cancelled_while_opening_closes_what_comes_back(store: Store) -> None:
    begun, go = threading.Event(), threading.Event()

    class Slow(RealFileIO):
        def create(self, path: Path) -> int:
            begun.set()
            go.wait(within(20))
            return super().create(path)

    async def enter() -> None:
        async with recording(store, run_id, SETTINGS, SystemClock(), io=Slow()):
            raise AssertionError

    run_id = new_run(store)
    before = set(threading.enumerate())
    task = asyncio.create_task(enter())
    await asyncio.to_thread(begun.wait, 20)
    task.cancel()
    await asyncio.sleep(0)
    go.set()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert not [one for one in {*threading.enumerate()} - before if one.name in {"abbe-capture", "abbe-ingest"}]
    path = segment_path(segment_folder(store.url, SETTINGS), run_id)
    assert read_segment(path).closed
    assert not is_active(path)


async def test_every_folder_that_is_made_is_synced(store: Store, tmp_path: Path) -> None:
    seen: list[Path] = []

    class Watching(RealFileIO):
        def sync_folder(self, folder: Path) -> None:
            seen.append(folder)
            super().sync_folder(folder)

    settings = CaptureSettings(folder=str(tmp_path / "a" / "b"), reserve_bytes=0)
    async with recording(store, new_run(store), settings, SystemClock(), io=Watching()):
        pass
    assert seen[:3] == [tmp_path, tmp_path / "a", tmp_path / "a" / "b"]


async def test_a_full_database_costs_no_processor_and_keeps_the_group_in_hand(store: Store) -> None:
    turns: list[int] = []

    def feed(recorder: CaptureRecorder) -> None:
        give(recorder)
        recorder.log.disk_full()
        recorder.log.flush()
        assert recorder.durable_seq == 49
        store_items = recorder.log._store
        recorder.log._store = lambda items: (turns.append(1), store_items(items))[1]
        threading.Event().wait(0.3)

    assert isinstance(await measured(store, run_id := new_run(store), feed), DiskFull)
    assert len(turns) < 5  # the thread sleeps; one that spins comes round thousands of times
    assert seqs(store, run_id) == list(range(50))


def test_a_full_postgresql_is_full() -> None:
    def error(original: object) -> StoreError:
        found = StoreError("no")
        found.__cause__ = OperationalError("insert full", {}, original)  # type: ignore[arg-type]
        return found

    assert is_full(error(SimpleNamespace(sqlstate="53100")))
    assert is_full(error(OSError("could not extend file: No space left on device")))
    assert is_full(error(RuntimeError("database or disk is full")))
    assert not is_full(error(RuntimeError("database is locked")))


def test_equal_inserts_of_two_are_looked_at_again(store: Store, monkeypatch) -> None:
    run_id = new_run(store)
    one = ChunkRecord(run_id, "bar", 0, 3, "bar/1", 1, b"abc", 1.0, 2.0, 3, 4)
    assert store.chunks.ingest([one]) == 1
    look, looks = store_measured._stored, []

    def too_early(connection, given):  # as PostgreSQL: the other's row is not visible at the first look
        looks.append(1)
        return {} if len(looks) == 1 else look(connection, given)

    monkeypatch.setattr(store_measured, "_stored", too_early)
    assert store.chunks.ingest([one]) == 0
    assert len(looks) == 2


async def test_a_database_that_never_comes_back_is_not_waited_for(store: Store, monkeypatch) -> None:
    monkeypatch.setattr(recorder_module, "CATCH_UP_S", 0.1)
    monkeypatch.setattr(ingest_module, "END_S", 0.1)
    go = threading.Event()
    monkeypatch.setattr(ingest_module.Ingest, "_give", lambda self, records: go.wait(within(20)))
    began_s = time.monotonic()
    failure = await measured(store, run_id := new_run(store), give)
    assert time.monotonic() - began_s < 10
    go.set()
    assert isinstance(failure, StoreError)
    assert store.runs.find(str(run_id)).status == "running"


async def test_a_segment_of_another_database_with_the_same_run_and_label_is_not_taken_over(tmp_path: Path) -> None:
    settings = CaptureSettings(reserve_bytes=65536, keep=True)
    url = f"sqlite:///{tmp_path / 'abbe.sqlite3'}"
    with Store.open(url) as store:
        async with recording(store, first := new_run(store), settings, SystemClock(), {"label": "r01"}) as recorder:
            give(recorder)
        recorder.release()
    (tmp_path / "abbe.sqlite3").rename(tmp_path / "before.sqlite3")  # closed: nothing of it is in other files
    with Store.open(url) as store:
        assert new_run(store) == first
        abandon(store, first)
        (told,) = recover_segments(store, settings)
        assert "belongs to no run" in told.text
        assert store.chunks.of_run(first) == []
