"""S5, S12: frames twice, late or exchanged; electric bursts that hit every n-th frame, on bytes and on the pty."""

from __future__ import annotations

import itertools
import os
import random
from collections.abc import Iterator

import pytest

from abbe.drivers.errors import LossyLine, Rebooted
from abbe.simulators.faults.serial_bytes import cut, delayed, every_nth, repeated, swapped
from tests.faults.rows_serial import S5_COUNTS
from tests.faults.serial_pure import honest, judged
from tests.faults.serial_rig import stage

LONG = os.environ.get("ABBE_TEST_LONG") == "1"
"""Every burst; every day each third."""
AT = 1500
MOST_LOST = 0.001


def batched(frames: Iterator[bytes], size: int) -> Iterator[list[bytes]]:
    while some := list(itertools.islice(frames, size)):
        yield some


async def played(case: str, frames: list[bytes], sent) -> tuple[list[int], object]:
    heard = await judged("S5", case, [b"".join(frames)], sent)
    return [sample.seq for sample in heard.tap.samples], heard


@pytest.mark.parametrize("count", S5_COUNTS)
async def test_duplicates(count):
    sent = honest(3000)
    seqs, heard = await played(f"duplicate {count}", repeated([s.frame() for s in sent], AT, count), sent)
    assert seqs == list(range(3000))
    assert heard.stream.tracker.duplicates == count


@pytest.mark.parametrize("count", S5_COUNTS)
async def test_a_late_frame_is_part_of_a_gap(count):
    sent = honest(3000)
    seqs, heard = await played(f"late {count}", delayed([s.frame() for s in sent], AT, count), sent)
    assert seqs == [n for n in range(3000) if n != AT]
    assert (heard.stream.tracker.duplicates, heard.stream.tracker.lost) == (1, 1)


async def test_a_frame_older_than_the_window_is_an_anomaly():
    sent = honest(3000)
    seqs, heard = await played("late 500", delayed([s.frame() for s in sent], AT, 500), sent)
    assert isinstance(heard.error, Rebooted)
    assert seqs == [n for n in range(AT + 501) if n != AT], "what came before it is good, nothing after it is taken"


@pytest.mark.parametrize("distance", S5_COUNTS)
async def test_frames_that_have_changed_places(distance):
    sent = honest(3000)
    seqs, heard = await played(f"swapped {distance}", swapped([s.frame() for s in sent], AT, distance), sent)
    missing = set(range(3000)) - set(seqs)
    assert seqs == sorted(set(seqs)), "each number once, in order"
    assert missing <= set(range(AT, AT + distance + 1)) or isinstance(heard.error, LossyLine)
    assert (heard.error is None) == (len(missing) <= 3000 * MOST_LOST)


@pytest.mark.parametrize("block", range(2, 202, 25))
async def test_bursts(block):
    sent = honest(3000)
    frames = [sample.frame() for sample in sent]
    for n in range(block, min(block + 25, 202), 1 if LONG else 3):
        pieces = (b"".join(frames) for frames in batched(every_nth(frames, n, random.Random(n)), 50))
        heard = await judged("S12", f"every {n}", pieces, sent)
        assert isinstance(heard.error, LossyLine), n
        assert heard.stream.tracker.lost / len(sent) <= 0.04, "ended as soon as it was sure, not at the end of the run"


@pytest.mark.parametrize("n", [1001, 2001, 5001])
async def test_rare_bursts_are_gaps_in_a_good_run(n):
    sent = honest(6000)
    heard = await judged("S12", f"every {n}", every_nth([s.frame() for s in sent], n, random.Random(n)), sent)
    assert heard.error is None
    hit = list(range(n - 1, 6000, n))
    assert [sample.seq for sample in heard.tap.samples] == [k for k in range(6000) if k not in hit]
    assert [batch.missing for batch in heard.tap.batches if batch.missing] == [1] * len(hit)


@pytest.mark.parametrize("n", [7, 101, 1001])
async def test_bursts_on_the_line(tmp_path, n):
    async with stage(tmp_path, "S12", f"every {n}") as on:
        await on.bar.identify()
        draw, passed = random.Random(n), 0

        def spoil(data: bytes):
            nonlocal passed
            for frame in cut(data):
                passed += 1
                yield next(every_nth([frame], 1, draw)) if passed % n == 0 else frame

        async def script() -> None:
            on.box.line.spoil = spoil
            await on.box.run(3000)

        await on.fault(script)
        assert isinstance(on.error, LossyLine) == (n < 1000)
        assert on.bar.counters.bad_frames or on.bar.counters.bad_bytes
        await on.judge(resumed=await on.again())
