"""A run on its way: into the segment, out to the database, and what its ledger says."""

from __future__ import annotations

import asyncio
import errno
import sqlite3
import threading
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from abbe.drivers.api import BarBatch, BarSample
from abbe.service.capture import ingest as ingest_module
from abbe.service.capture.recorder import CaptureRecorder, recording
from abbe.service.capture.recovery import ledger_of, read_segment
from abbe.service.capture.segment import CHUNK, CLOSE, OPEN
from abbe.service.capture.settings import CaptureSettings, segment_folder, segment_path
from abbe.service.clock import SystemClock
from abbe.service.domain.measured import ChunkRecord
from abbe.service.errors import CaptureConflict, CaptureFault, ConfigError, DiskFull
from abbe.service.runs.chunks import decode_bar, decode_json
from abbe.service.storage.store import Store
from tests.patience import within
from tests.service.capture.capture_bench import BrokenDisk, JumpingClock, SmallDisk, assert_true, batch, new_run

KEEP = CaptureSettings(reserve_bytes=65536, keep=True)


@pytest.fixture
def store(tmp_path: Path):
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as opened:
        yield opened


async def record(store: Store, run_id: int, feed: Callable[[CaptureRecorder], Awaitable[None]], seen: list[CaptureRecorder], **options):
    async with recording(store, run_id, KEEP, SystemClock(), **options) as recorder:
        seen.append(recorder)
        await feed(recorder)


async def many(recorder: CaptureRecorder, total: int, *, until_refused: bool = False) -> None:
    tap = recorder.tap()
    for first in range(0, total, 50):
        tap.take(batch(first, 50))
        recorder.log.flush()
        if until_refused:
            await recorder.add_bar(batch(first, 50))


def stored(store: Store, run_id: int):
    return [sample for chunk in store.chunks.of_run(run_id, "bar") for sample in decode_bar(chunk.payload)]


async def test_every_sample_is_in_the_segment_and_in_the_database_and_the_ledger_says_so(store: Store) -> None:
    run_id, seen = new_run(store), []
    async with recording(store, run_id, KEEP, SystemClock(), published=lambda *news: seen.append(news)) as recorder:
        tap = recorder.tap()
        tap.take(batch(0, 50))
        tap.take(batch(50, 50, status=8 | 1))
        tap.take(batch(110, 40, missing=10))
        await recorder.add_record({"host_s": 1.0, "ctrl_us": 7, "displacement_tenth_nm": 5})
        await recorder.flush()
        assert recorder.durable_seq == 149
    assert seen[-2:] == [("bar", 0, 149), ("laser", 0, 0)]
    found = stored(store, run_id)
    assert [one.seq for one in found] == [*range(100), *range(110, 150)]
    assert_true(found)
    doc = recorder.doc()
    assert doc["gaps"] == [
        {"stream": 0, "first": 100, "last": 109, "cause": "lost or damaged on the line", "before_us": 100_000, "after_us": 111_000}
    ]
    assert {key: doc["capture"][key] for key in ("stored_valid", "stored_flagged", "flags", "in_gaps", "unaccounted")} == {
        "stored_valid": 90,
        "stored_flagged": 50,
        "flags": {"out of range": 50},
        "in_gaps": 10,
        "unaccounted": 0,
    }
    held = read_segment(recorder.log.segment.path)
    assert held.whole
    assert held.closed
    assert [record.kind for record in held.records][0 :: len(held.records) - 1] == [OPEN, CLOSE]
    assert held.head.hex() == doc["capture"]["head_sha256"]
    ledger = ledger_of(store.chunks.of_run(run_id))
    assert (ledger.stored, ledger.unaccounted(), ledger.duplicates(), len(ledger.gaps)) == (140, [], 0, 1)
    assert decode_json(store.chunks.of_run(run_id, "laser")[0].payload) == [{"host_s": 1.0, "ctrl_us": 7, "displacement_tenth_nm": 5}]


async def test_a_segment_is_deleted_when_the_database_has_everything(store: Store) -> None:
    run_id = new_run(store)
    async with recording(store, run_id, CaptureSettings(reserve_bytes=65536), SystemClock()) as recorder:
        recorder.tap().take(batch(0, 5))
    path = recorder.log.segment.path
    assert path.exists()  # until the run is closed in the database as well
    recorder.discard()
    assert not path.exists()


async def test_two_streams_of_a_run_are_two_streams_of_its_ledger(store: Store) -> None:
    run_id = new_run(store)
    async with recording(store, run_id, KEEP, SystemClock()) as recorder:
        recorder.tap().take(batch(0, 30))
        recorder.tap().take(batch(5, 30, missing=5))
    ledger = ledger_of(store.chunks.of_run(run_id))
    assert ledger.stored_spans(0) == [(0, 29)]
    assert ledger.stored_spans(1) == [(5, 34)]
    assert [(gap.stream, gap.first, gap.last, gap.before_us) for gap in ledger.gaps] == [(1, 0, 4, None)]
    assert ledger.unaccounted() == []


async def test_a_failed_run_says_that_more_may_have_come(store: Store) -> None:
    seen: list[CaptureRecorder] = []

    async def feed(recorder: CaptureRecorder) -> None:
        recorder.tap().take(batch(0, 30))
        raise RuntimeError("cable pulled")

    with pytest.raises(RuntimeError):
        await record(store, new_run(store), feed, seen)
    assert [(gap["first"], gap["last"], gap["cause"]) for gap in seen[0].doc()["gaps"]] == [(30, None, "cable pulled")]


async def test_a_locked_database_delays_nothing_but_itself(store: Store, tmp_path: Path) -> None:
    run_id = new_run(store)
    other = sqlite3.connect(tmp_path / "abbe.sqlite3", isolation_level=None)
    async with recording(store, run_id, KEEP, SystemClock()) as recorder:
        other.execute("BEGIN IMMEDIATE")
        tap = recorder.tap()
        for first in range(0, 2000, 20):
            tap.take(batch(first, 20))
        async with asyncio.timeout(within(10)):
            await recorder.flush()
        assert recorder.durable_seq == 1999
        assert recorder.ingest.ingested < 20  # what came before the lock
        other.execute("ROLLBACK")
        other.close()
    assert [one.seq for one in stored(store, run_id)] == list(range(2000))


async def test_the_database_gets_many_chunks_in_one_transaction_and_the_end_waits_for_no_more(store: Store, monkeypatch) -> None:
    monkeypatch.setattr(ingest_module, "TOGETHER_S", 3600.0)
    monkeypatch.setattr(ingest_module, "BATCH", 8)
    given = []
    monkeypatch.setattr(store.chunks, "ingest", lambda chunks, give=store.chunks.ingest: (given.append(len(chunks)), give(chunks)))
    run_id = new_run(store)
    async with asyncio.timeout(within(60)), recording(store, run_id, KEEP, SystemClock()) as recorder:
        tap = recorder.tap()
        for first in range(0, 200, 20):
            tap.take(batch(first, 20))
            await recorder.flush()
        assert recorder.durable_seq == 199
    assert given == [7, 3]  # the opening record came with the first, and is not a chunk
    assert [one.seq for one in stored(store, run_id)] == list(range(200))


def test_the_same_chunk_again_is_accepted_and_another_one_refused(store: Store) -> None:
    run_id = new_run(store)
    one = ChunkRecord(run_id, "bar", 0, 3, "bar/1", 1, b"abc", 1.0, 2.0, 3, 4)
    assert store.chunks.ingest([one]) == 1
    assert store.chunks.ingest([one]) == 0
    other = ChunkRecord(run_id, "bar", 0, 3, "bar/1", 1, b"abd", 1.0, 2.0, 3, 4)
    new = ChunkRecord(run_id, "bar", 1, 3, "bar/1", 1, b"abd", 1.0, 2.0, 3, 4)
    with pytest.raises(CaptureConflict, match="other content"):
        store.chunks.ingest([new, other])
    assert store.chunks.crcs(run_id) == {("bar", 0): 1}


async def test_utc_jumps_of_a_year_change_no_sample(tmp_path: Path) -> None:
    payloads, offsets = [], []
    for jumps in (False, True):
        folder = tmp_path / str(jumps)
        folder.mkdir()
        with Store.open(f"sqlite:///{folder / 'abbe.sqlite3'}") as store:
            run_id = new_run(store)
            async with recording(store, run_id, KEEP, JumpingClock(jumps)) as recorder:
                tap = recorder.tap()
                for first in range(0, 400, 40):
                    tap.take(batch(first, 40))
                    await recorder.flush()
            payloads.append([(c.first_device_us, c.last_device_us, c.first_host_s, c.payload) for c in store.chunks.of_run(run_id, "bar")])
            records = read_segment(recorder.log.segment.path).records
            offsets.append({round(record.utc_offset_s) for record in records if record.kind == CHUNK})
    assert payloads[0] == payloads[1]
    assert len(offsets[0]) == 1
    assert len(offsets[1]) > 1  # the jumps were there, and were noted


@pytest.mark.parametrize("room", [66_000, 67_000, 70_000, 80_000])
async def test_a_full_disk_ends_the_run_and_keeps_what_was_acknowledged(store: Store, room: int) -> None:
    run_id, durable, seen = new_run(store), [], []
    published = lambda channel, stream, seq: durable.append(seq)  # noqa: E731
    with pytest.raises(DiskFull, match="no space"):
        await record(store, run_id, lambda r: many(r, 20_000, until_refused=True), seen, io=SmallDisk(room), published=published)
    held = read_segment(seen[0].log.segment.path)
    assert held.whole
    assert held.closed
    seqs = [one.seq for one in stored(store, run_id)]
    assert seqs == list(range(durable[-1] + 1))
    assert durable[-1] < 19_999
    assert seen[0].log.drafter.ledger.unaccounted() == []


async def test_what_comes_after_the_disk_is_full_is_an_explicit_gap(store: Store) -> None:
    run_id = new_run(store)
    with pytest.raises(DiskFull):
        await record(store, run_id, lambda r: many(r, 5000), [], io=SmallDisk(67_000))
    ledger = ledger_of(store.chunks.of_run(run_id))
    assert ledger.unaccounted() == []
    assert ledger.stored + sum(gap.missing for gap in ledger.gaps) == 5000
    assert "no space" in ledger.gaps[-1].cause


async def test_without_room_for_the_reserve_nothing_begins(store: Store) -> None:
    with pytest.raises(DiskFull, match="reserve disk space"):
        async with recording(store, new_run(store), KEEP, SystemClock(), io=SmallDisk(1000)):
            pass


@pytest.mark.parametrize(
    ("operation", "number", "at"),
    [
        ("sync", errno.EIO, 3),
        ("sync", errno.ENOSPC, 3),
        ("append", errno.EIO, 3),
        ("append", errno.EROFS, 3),
        ("sync", errno.EIO, 1),
        ("create", errno.EMFILE, 1),
        ("create", errno.EROFS, 1),
        ("sync_folder", errno.EIO, 1),
        ("sync_folder", errno.EIO, 3),
    ],
)
async def test_an_error_of_the_disk_is_fatal_for_the_file_and_never_tried_again(store: Store, operation: str, number: int, at: int) -> None:
    run_id, durable, disk = new_run(store), [-1], BrokenDisk(operation, number, at)
    published = lambda channel, stream, seq: durable.append(seq)  # noqa: E731
    with pytest.raises(CaptureFault):
        await record(store, run_id, lambda r: many(r, 2000), [], io=disk, published=published)
    after = disk.calls[max(k for k, name in enumerate(disk.calls) if name == operation) :]
    assert after == [operation]  # nothing was written or synced after it
    assert [one.seq for one in stored(store, run_id)] == list(range(durable[-1] + 1))


async def test_a_chunk_that_contradicts_the_database_stops_the_run(store: Store) -> None:
    run_id = new_run(store)
    store.chunks.ingest([ChunkRecord(run_id, "bar", 0, 1, "bar/1", 1, b"other", 0.0, 0.0, 0, 0)])
    with pytest.raises(CaptureConflict):
        async with recording(store, run_id, KEEP, SystemClock()) as recorder:
            recorder.tap().take(batch(0, 50))


async def test_a_stuck_disk_holds_the_tap_and_nobody_else(store: Store) -> None:
    from abbe.service.capture.segment import RealFileIO

    class Stuck(RealFileIO):
        def __init__(self) -> None:
            self.go = threading.Event()
            self.syncs = 0

        def sync(self, handle: int) -> None:
            self.syncs += 1
            if self.syncs > 1:
                self.go.wait(within(20))
            super().sync(handle)

    disk = Stuck()
    async with recording(store, new_run(store), KEEP, SystemClock(), io=disk) as recorder:
        tap = recorder.tap()

        def push() -> None:
            for first in range(0, 40_000, 100):
                tap.take(batch(first, 100))

        pushing = asyncio.create_task(asyncio.to_thread(push))
        done, _ = await asyncio.wait([pushing], timeout=0.5)
        assert not done  # back-pressure: the bytes stay in the driver's ring
        disk.go.set()
        await pushing
        await recorder.flush()
        assert recorder.durable_seq == 39_999


def test_where_segments_are() -> None:
    plain = CaptureSettings()
    assert segment_folder("sqlite:////data/abbe.sqlite3", plain) == Path("/data/abbe.sqlite3-capture")
    with pytest.raises(ConfigError, match="no folder"):
        segment_folder("postgresql://u@h/abbe", plain)
    one = segment_folder("postgresql://u:p@h/abbe", CaptureSettings("/spool"), "0a" * 16)
    again = segment_folder("postgresql://v@127.0.0.1:5432/abbe", CaptureSettings("/spool"), "0a" * 16)
    other = segment_folder("postgresql://u:p@h/abbe", CaptureSettings("/spool"), "0b" * 16)
    assert one.parent == other.parent == Path("/spool")
    assert one == again != other
    assert segment_path(one, 7).name == "run-00000007.seg"


async def test_a_database_in_memory_leaves_nothing_behind() -> None:
    with Store.open("sqlite://") as store:
        async with recording(store, new_run(store), CaptureSettings(), SystemClock()) as recorder:
            recorder.tap().take(batch(0, 50))
        folder = recorder.log.segment.path.parent
        assert folder.is_dir()
        recorder.discard()
        assert not folder.exists()


async def test_postgresql_gets_the_same(postgres: Callable[[], str], tmp_path: Path) -> None:
    with Store.open(postgres()) as store:
        run_id = new_run(store)
        settings = CaptureSettings(folder=str(tmp_path), reserve_bytes=65536)
        async with recording(store, run_id, settings, SystemClock()) as recorder:
            tap = recorder.tap()
            for first in range(0, 1000, 50):
                tap.take(batch(first, 50))
        assert [one.seq for one in stored(store, run_id)] == list(range(1000))
        assert store.chunks.ingest(store.chunks.of_run(run_id)) == 0


async def test_a_defect_in_the_capture_ends_the_run_and_blocks_nobody(store: Store) -> None:
    seen: list[CaptureRecorder] = []

    async def feed(recorder: CaptureRecorder) -> None:
        tap = recorder.tap()
        tap.take(batch(0, 50))
        recorder.log.flush()
        impossible = BarBatch(0.0, (BarSample(50, -1, 0, 8),))  # no device clock is negative: it cannot be packed
        for _ in range(20_000):
            tap.take(impossible)

    with pytest.raises(CaptureFault, match="the capture failed"):
        await record(store, run_id := new_run(store), feed, seen)
    assert [one.seq for one in stored(store, run_id)] == list(range(50))
    assert ledger_of(store.chunks.of_run(run_id)).unaccounted() == []
    assert read_segment(seen[0].log.segment.path).closed


@pytest.mark.parametrize("at", range(1, 13))
async def test_no_space_at_any_write_of_a_run(store: Store, at: int) -> None:
    """The first write is the opening record, the last the closing one; each may be the one that finds no room."""
    run_id, durable, seen = new_run(store), [-1], []
    disk = BrokenDisk("append", errno.ENOSPC, at)
    published = lambda channel, stream, seq: durable.append(seq)  # noqa: E731
    work = record(store, run_id, lambda r: many(r, 500), seen, io=disk, published=published)
    if at == 12:
        await work  # only the closing record needed the reserve: nothing is missing
    else:
        with pytest.raises(DiskFull):
            await work
    assert [one.seq for one in stored(store, run_id)] == list(range(durable[-1] + 1))
    assert durable[-1] == {1: -1, 12: 499}.get(at, 50 * (at - 1) - 1)
    if seen:
        held = read_segment(seen[0].log.segment.path)
        assert (held.whole, held.closed) == (True, True)
        ledger = ledger_of(store.chunks.of_run(run_id))
        assert ledger.stored + sum(gap.missing for gap in ledger.gaps) == 500
        assert ledger.unaccounted() == []
