"""Segments that cannot simply be taken over: damaged, of another version, of a closed run, or no segments at all."""

from __future__ import annotations

import fcntl
import json
import os
import struct
import subprocess
import sys
import zlib
from dataclasses import replace
from pathlib import Path

import pytest

from abbe.service.capture import recovery
from abbe.service.capture.ingest import chunk_of
from abbe.service.capture.ledger import DAMAGED, TORN, Drafter
from abbe.service.capture.recovery import ledger_of, read_segment, recover_segments
from abbe.service.capture.segment import CHUNK, CLOSE, Record, Segment, encode, scan
from abbe.service.capture.settings import CaptureSettings, segment_path
from abbe.service.errors import CaptureFault
from abbe.service.storage.store import Store
from tests.service.capture.capture_bench import Tape, batch, segment_bytes
from tests.service.capture.test_recovery import GROUPS, crashed, folder, seqs, store  # noqa: F401 - fixtures

PLAIN = CaptureSettings()


def pieces(whole: bytes) -> list[bytes]:
    found, at = [], 0
    for record in scan(whole).records:
        size = len(encode(record))
        found.append(whole[at : at + size])
        at += size
    return found


def spoiled(piece: bytes) -> bytes:
    return piece[:150] + bytes([piece[150] ^ 1]) + piece[151:]


@pytest.mark.parametrize("in_database", [11, 12])
def test_a_closed_runs_segment_is_deleted_only_if_the_database_has_all_of_it(store: Store, folder: Path, in_database: int) -> None:  # noqa: F811
    run_id = crashed(store, folder, in_database=in_database)
    store.runs.finish(run_id, "failed", "somebody closed it", {})
    told = recover_segments(store, PLAIN)
    kept = segment_path(folder, run_id).with_suffix(".orphan")
    assert kept.exists() == (in_database == 11)
    assert ["1 of its 12 chunks are not in the database" in one.text for one in told] == [True] * (12 - in_database)
    assert not segment_path(folder, run_id).exists()


def test_nothing_that_is_set_aside_is_overwritten(store: Store, folder: Path) -> None:  # noqa: F811
    for content in (b"1", b"2", b"3"):
        segment_path(folder, 99).write_bytes(content)
        recover_segments(store, PLAIN)
    found = {path.name: path.read_bytes() for path in folder.glob("*.orphan*")}
    assert found == {"run-00000099.orphan": b"1", "run-00000099.orphan-2": b"2", "run-00000099.orphan-3": b"3"}


def newer(piece: bytes) -> bytes:
    body = piece[:4] + b"\x02" + piece[5:-4]
    return body + struct.pack("<I", zlib.crc32(body))


@pytest.mark.parametrize("place", [0, 5, 12])
def test_a_segment_of_a_newer_version_is_neither_cut_nor_closed(store: Store, folder: Path, place: int) -> None:  # noqa: F811
    parts = pieces(segment_bytes(1, GROUPS))
    parts[place] = newer(parts[place])
    run_id = crashed(store, folder, b"".join(parts))
    path = segment_path(folder, run_id)
    with pytest.raises(CaptureFault, match="made by a newer version"):
        read_segment(path)
    (told,) = recover_segments(store, PLAIN)
    assert "made by a newer version" in told.text
    assert path.read_bytes() == b"".join(parts)
    assert store.runs.find(str(run_id)).status == "running"
    assert store.chunks.of_run(run_id) == []


def test_a_tail_is_copied_before_it_is_cut(store: Store, folder: Path) -> None:  # noqa: F811
    whole = segment_bytes(1, GROUPS)
    run_id = crashed(store, folder, whole + b"half a record")
    recover_segments(store, PLAIN)
    assert segment_path(folder, run_id).with_suffix(".tail").read_bytes() == b"half a record"
    (gap,) = ledger_of(store.chunks.of_run(run_id)).gaps
    assert (gap.first, gap.last, gap.cause) == (300, None, TORN)


def test_an_acknowledged_last_chunk_that_is_damaged_is_known_from_the_end_of_the_segment(store: Store, folder: Path) -> None:  # noqa: F811
    tape, drafter = Tape(), Drafter(1, lambda: 0.0)
    segment = Segment(tape, Path("x"))
    segment.append([drafter.opening({"label": "r01"})])
    for group in GROUPS:
        segment.append(drafter.drafts([(0, one) for one in group]))
    segment.append([drafter.closing({"status": "complete", "durable": {"bar": [0, 299]}})])
    parts = pieces(b"".join(data for operation, data in tape.operations if operation == "append"))
    parts[12] = spoiled(parts[12])
    run_id = crashed(store, folder, b"".join(parts))
    recover_segments(store, PLAIN)
    (gap,) = ledger_of(store.chunks.of_run(run_id)).gaps
    assert (gap.first, gap.last, gap.cause) == (275, 299, DAMAGED)
    assert segment_path(folder, run_id).with_suffix(".damaged").read_bytes() == b"".join(parts)


def test_gaps_of_the_recovery_get_numbers_that_neither_segment_nor_database_has(store: Store, folder: Path) -> None:  # noqa: F811
    groups = [[batch(0, 25)], [batch(30, 25, missing=5)], [batch(55, 25)], [batch(85, 25, missing=5)], [batch(110, 25)]]
    parts = pieces(segment_bytes(1, groups))
    records = scan(b"".join(parts)).records
    gaps = [k for k, one in enumerate(records) if one.channel == "gaps"]
    run_id = crashed(store, folder, b"".join([*parts[: gaps[1]], spoiled(parts[gaps[1]]), *parts[gaps[1] + 1 :]]))
    store.chunks.ingest([chunk_of(records[gaps[1]])])  # the database has the gap that is damaged here
    lost = next(k for k, one in enumerate(records) if one.first_seq == 55 and one.kind == CHUNK)
    path = segment_path(folder, run_id)
    data = bytearray(path.read_bytes())
    data[sum(len(one) for one in parts[:lost]) + 150] ^= 1
    path.write_bytes(data)
    recover_segments(store, PLAIN)
    ledger = ledger_of(store.chunks.of_run(run_id))
    assert sorted((gap.first, gap.last) for gap in ledger.gaps) == [(25, 29), (55, 79), (80, 84)]
    assert (ledger.unaccounted(), ledger.duplicates()) == ([], 0)
    end = store.runs.find(str(run_id)).end_doc
    assert end is not None
    assert (end["capture"]["unaccounted"], end["capture"]["in_gaps"]) == (0, 35)


def test_a_damaged_beginning_of_a_second_stream_is_a_gap_of_that_stream(store: Store, folder: Path) -> None:  # noqa: F811
    tape, drafter = Tape(), Drafter(1, lambda: 0.0)
    segment = Segment(tape, Path("x"))
    segment.append([drafter.opening({"label": "r01"})])
    for stream, first, count in ((0, 0, 30), (1, 0, 40), (1, 40, 20)):
        segment.append(drafter.drafts([(stream, batch(first, count))]))
    parts = pieces(b"".join(data for operation, data in tape.operations if operation == "append"))
    run_id = crashed(store, folder, b"".join([*parts[:2], spoiled(parts[2]), parts[3]]))
    recover_segments(store, PLAIN)
    end = store.runs.find(str(run_id)).end_doc
    assert end is not None
    assert [(gap["stream"], gap["first"], gap["last"]) for gap in end["gaps"]] == [(1, 0, 39)]
    assert end["capture"]["unaccounted"] == 0


def test_bad_segments_stop_neither_the_others_nor_the_machine(store: Store, folder: Path, monkeypatch) -> None:  # noqa: F811
    (folder / "notes.seg").write_bytes(b"of a stranger")
    unreadable = crashed(store, folder, label="r01")
    odd = Record(CLOSE, 2, "run", "json/1", payload=b"no json")
    parts = b"".join(pieces(segment_bytes(2, GROUPS, label="r02")))
    senseless = crashed(store, folder, parts + encode(replace(odd, previous=scan(parts).head)), label="r02")
    good = crashed(store, folder, label="r03")
    read = recovery._read

    def reads(path: Path):
        if path == segment_path(folder, unreadable):
            raise OSError(5, "Input/output error")
        return read(path)

    monkeypatch.setattr(recovery, "_read", reads)
    told = {one.run: one for one in recover_segments(store, PLAIN)}
    assert "its name is not that of a segment" in told[0].text
    assert (folder / "notes.conflict").exists()
    assert "Input/output error" in store.runs.find(str(unreadable)).reason
    assert {store.runs.find(str(one)).status for one in (unreadable, senseless, good)} == {"interrupted"}
    assert segment_path(folder, unreadable).with_suffix(".conflict").exists()
    assert segment_path(folder, senseless).with_suffix(".conflict").exists()
    assert seqs(store, good) == list(range(300))


def test_only_one_recovers_at_a_time(store: Store, folder: Path, monkeypatch) -> None:  # noqa: F811
    run_id = crashed(store, folder)
    exclusive_lock = recovery.exclusive_lock
    monkeypatch.setattr(recovery, "exclusive_lock", lambda path: exclusive_lock(path, 0.1))
    other = os.open(folder / "recovery.lock", os.O_RDWR | os.O_CREAT)
    fcntl.flock(other, fcntl.LOCK_EX)
    (told,) = recover_segments(store, PLAIN)
    os.close(other)
    assert "another process" in told.text
    assert store.runs.find(str(run_id)).status == "running"
    recover_segments(store, PLAIN)
    assert store.runs.find(str(run_id)).status == "interrupted"


CUT = """
import json, sys, threading
from pathlib import Path
from abbe.service.capture import recovery
path = Path(sys.argv[1])
def cut(data, scan=recovery.scan):
    path.write_bytes(b"")  # while it is being read
    return scan(data)
recovery.scan = cut
print(json.dumps(len(recovery.read_segment(path).records)))
"""


def test_a_file_that_is_cut_while_it_is_read_does_not_kill_the_process(tmp_path: Path) -> None:
    path = tmp_path / "run-00000001.seg"
    path.write_bytes(segment_bytes(1, GROUPS))
    done = subprocess.run([sys.executable, "-c", CUT, str(path)], capture_output=True, text=True, check=False)
    assert (done.returncode, json.loads(done.stdout or "0")) == (0, 13), done.stderr
