"""What a crash leaves in segments: taken over, cut where it is torn, and never more lost than what was damaged."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest

from abbe.service.capture.ingest import chunk_of
from abbe.service.capture.recovery import DAMAGED, ledger_of, read_segment, recover_segments
from abbe.service.capture.segment import CHUNK, encode, scan
from abbe.service.capture.settings import CaptureSettings, segment_path
from abbe.service.domain.measured import RunRecord
from abbe.service.runs.chunks import decode_bar
from abbe.service.storage.store import Store
from tests.service.capture.capture_bench import abandon, assert_true, batch, new_run, segment_bytes

GROUPS = [[batch(first, 25)] for first in range(0, 300, 25)]


@pytest.fixture
def store(tmp_path: Path):
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as opened:
        yield opened


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "abbe.sqlite3-capture"
    path.mkdir()
    return path


def crashed(store: Store, folder: Path, data: bytes | None = None, *, in_database: int = 0, label: str = "r01") -> int:
    """A run whose process is gone, with a segment, and the first chunks of it in the database."""
    run_id = new_run(store, label)
    whole = segment_bytes(run_id, GROUPS, label=label)
    store.chunks.ingest([chunk_of(record) for record in scan(whole).records if record.kind == CHUNK][:in_database])
    segment_path(folder, run_id).write_bytes(whole if data is None else data)
    abandon(store, run_id)
    return run_id


def seqs(store: Store, run_id: int) -> list[int]:
    found = [sample for chunk in store.chunks.of_run(run_id, "bar") for sample in decode_bar(chunk.payload)]
    assert_true(found)
    return [one.seq for one in found]


@pytest.mark.parametrize("in_database", [0, 5, 12])
def test_what_the_database_lacks_is_taken_over_and_the_run_is_marked(store: Store, folder: Path, in_database: int) -> None:
    run_id = crashed(store, folder, in_database=in_database)
    assert store.runs.find(str(run_id)).visible_status == "incomplete"
    (done,) = recover_segments(store, CaptureSettings())
    assert (done.run, done.new_chunks, done.cut_bytes) == (run_id, 12 - in_database, 0)
    run: RunRecord = store.runs.find("r01")
    assert run.visible_status == "interrupted"
    assert "the process ended before the run was closed" in run.reason
    assert run.end_doc is not None
    assert run.end_doc["capture"]["stored_valid"] == 300
    assert seqs(store, run_id) == list(range(300))
    assert recover_segments(store, CaptureSettings()) == []
    assert not segment_path(folder, run_id).exists()


@pytest.mark.parametrize("keep", [1, 60, 600])
def test_a_torn_tail_is_cut_off_and_nothing_before_it(store: Store, folder: Path, keep: int) -> None:
    whole = segment_bytes(1, GROUPS)
    last = len(encode(scan(whole).records[-1]))
    data = whole[: len(whole) - last + min(keep, last - 1)]
    run_id = crashed(store, folder, data)
    (done,) = recover_segments(store, CaptureSettings(keep=True))
    assert done.cut_bytes == min(keep, last - 1)
    assert seqs(store, run_id) == list(range(275))
    assert read_segment(segment_path(folder, run_id)).whole


def test_damage_is_a_gap_unless_the_database_has_the_chunk(store: Store, folder: Path) -> None:
    whole = bytearray(segment_bytes(1, GROUPS))
    records = scan(bytes(whole)).records
    at = sum(len(encode(one)) for one in records[:5]) + 200  # in the fifth chunk, samples 100 to 124
    whole[at] ^= 1
    run_id = crashed(store, folder, bytes(whole), in_database=0)
    recover_segments(store, CaptureSettings())
    assert seqs(store, run_id) == [*range(100), *range(125, 300)]
    ledger = ledger_of(store.chunks.of_run(run_id))
    assert [(gap.first, gap.last, gap.cause) for gap in ledger.gaps] == [(100, 124, DAMAGED)]
    assert ledger.unaccounted() == []
    end = store.runs.find("r01").end_doc
    assert end is not None
    assert end["gaps"][0]["cause"] == DAMAGED


def test_damage_costs_nothing_where_the_database_was_ahead(store: Store, folder: Path) -> None:
    whole = bytearray(segment_bytes(1, GROUPS))
    whole[1000] ^= 1
    run_id = crashed(store, folder, bytes(whole), in_database=6)
    recover_segments(store, CaptureSettings())
    assert seqs(store, run_id) == list(range(300))
    assert ledger_of(store.chunks.of_run(run_id)).gaps == []


def test_every_flipped_byte_is_found_and_costs_one_record_at_the_most() -> None:
    whole = segment_bytes(1, GROUPS[:8], closed=True)
    records = scan(whole).records
    ends, at = [], 0
    for record in records:
        at += len(encode(record))
        ends.append(at)
    for k in range(len(whole)):
        data = bytearray(whole)
        data[k] ^= 1 << (k % 8)
        found = scan(bytes(data))
        hit = next(n for n, end in enumerate(ends) if k < end)
        assert not found.whole, k
        assert found.records == [one for n, one in enumerate(records) if n != hit], k
        assert found.good_bytes == (ends[-2] if hit == len(records) - 1 else ends[-1])


def test_exchanged_and_missing_records_break_the_chain() -> None:
    whole = segment_bytes(1, GROUPS)
    pieces = [encode(one) for one in scan(whole).records]
    assert scan(b"".join(pieces)).whole
    swapped = [*pieces[:3], pieces[4], pieces[3], *pieces[5:]]
    assert scan(b"".join(swapped)).broken_links == [3, 4, 5]
    assert scan(b"".join([*pieces[:3], *pieces[4:]])).broken_links == [3]


def test_a_recorded_end_that_the_database_never_heard_of(store: Store, folder: Path) -> None:
    run_id = crashed(store, folder, segment_bytes(1, GROUPS, closed=True))
    recover_segments(store, CaptureSettings())
    assert "recorded to its end (complete)" in store.runs.find("r01").reason
    assert seqs(store, run_id) == list(range(300))


def test_a_segment_that_was_only_just_made(store: Store, folder: Path) -> None:
    run_id = crashed(store, folder, b"")
    recover_segments(store, CaptureSettings())
    assert store.runs.find(str(run_id)).visible_status == "interrupted"


def test_runs_of_others_and_living_runs_are_left_alone(store: Store, folder: Path) -> None:
    living = new_run(store, "living")
    store.commit(lambda c: c.exec_driver_sql(f"UPDATE runs SET owner_pid = 1, owner_host = 'elsewhere' WHERE id = {living}"))
    segment_path(folder, living).write_bytes(segment_bytes(living, GROUPS))
    stranger = segment_path(folder, 99)
    stranger.write_bytes(segment_bytes(99, GROUPS))
    (said,) = recover_segments(store, CaptureSettings())
    assert "belongs to no run" in said.text
    assert segment_path(folder, living).exists()
    assert store.runs.find("living").status == "running"
    assert stranger.with_suffix(".orphan").exists()


def test_another_database_with_the_same_numbers(store: Store, folder: Path) -> None:
    run_id = new_run(store, "other")
    segment_path(folder, run_id).write_bytes(segment_bytes(run_id, GROUPS))  # it says that it is r01
    abandon(store, run_id)
    recover_segments(store, CaptureSettings())
    assert store.chunks.of_run(run_id) == []
    assert store.runs.find("other").status == "running"


def test_a_contradiction_is_set_aside_and_stops_nobody_else(store: Store, folder: Path, tmp_path: Path) -> None:
    run_id = crashed(store, folder, in_database=3)
    with sqlite3.connect(tmp_path / "abbe.sqlite3") as direct:
        direct.execute("UPDATE chunks SET crc32 = 1 WHERE seq = 1")
    direct.close()
    next_id = crashed(store, folder, label="r02")
    bad, good = recover_segments(store, CaptureSettings())
    assert "CAP-003" in bad.text
    assert "chunk 1 of channel 'bar'" in store.runs.find(str(run_id)).reason
    assert (store.runs.find(str(run_id)).status, (good.run, good.new_chunks)) == ("interrupted", (next_id, 12))
    assert segment_path(folder, run_id).with_suffix(".conflict").exists()
    assert recover_segments(store, CaptureSettings()) == []
