"""How long a start takes after a crash when the database holds millions of samples."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from abbe.service.capture.ingest import chunk_of
from abbe.service.capture.ledger import Drafter
from abbe.service.capture.recovery import recover_segments
from abbe.service.capture.segment import CHUNK, Record, Segment
from abbe.service.capture.settings import CaptureSettings, segment_folder, segment_path
from abbe.service.runs.chunks import encode_bar
from abbe.service.storage.store import Store
from tests.service.capture.capture_bench import Tape, abandon, new_run, samples

SAMPLES = 10_000_000 if os.environ.get("ABBE_TEST_LONG") else 1_000_000
RUNS, PER_CHUNK = 10, 25
BEHIND = 10
"""Chunks that the segment has and the database lacks."""


def chunks(run_id: int, begin: int, end: int) -> Iterator[Record]:
    payload = encode_bar(samples(0, PER_CHUNK))
    for k in range(begin, end):
        yield Record(CHUNK, run_id, "bar", "bar/1", k, 0, 1, PER_CHUNK * k, PER_CHUNK, 8, payload=payload)


@pytest.mark.timeout(600)
def test_ready_within_two_seconds_of_work(tmp_path: Path) -> None:
    """One of ten runs was cut off; opening the database and taking it over is measured, in CPU time: the computer may be busy."""
    url, count = f"sqlite:///{tmp_path / 'abbe.sqlite3'}", SAMPLES // RUNS // PER_CHUNK
    with Store.open(url) as store:
        for number in range(RUNS):
            run_id = new_run(store, f"r{number}")
            for at in range(0, count, 4000):
                store.chunks.ingest([chunk_of(one) for one in chunks(run_id, at, min(at + 4000, count))])
            if number < RUNS - 1:
                store.runs.finish(run_id, "complete", "", {})
        abandon(store, run_id)
    tape = Tape()
    segment, drafter = Segment(tape, Path("x")), Drafter(run_id, lambda: 0.0)
    segment.append([drafter.opening({"label": f"r{RUNS - 1}"})])
    segment.append(list(chunks(run_id, 0, count + BEHIND)))
    path = segment_path(segment_folder(url, CaptureSettings()), run_id)
    path.parent.mkdir()
    path.write_bytes(b"".join(data for operation, data in tape.operations if operation == "append"))
    cpu_s, wall_s = time.process_time(), time.perf_counter()
    with Store.open(url) as store:
        (done,) = recover_segments(store, CaptureSettings())
        cpu_s, wall_s = time.process_time() - cpu_s, time.perf_counter() - wall_s
        assert store.runs.find(str(run_id)).end_doc["capture"]["stored_valid"] == (count + BEHIND) * PER_CHUNK
    print(f"{SAMPLES} samples, {SAMPLES // RUNS} of them in the open run: {cpu_s:.2f} s of CPU, {wall_s:.2f} s")  # noqa: T201
    assert done.new_chunks == BEHIND
    assert cpu_s < 2.0 * SAMPLES / 10_000_000 + 0.2
