"""The thread that only reads, its ring, and what a full ring does to the machine."""

from __future__ import annotations

import asyncio
import os
import threading
import tty
from collections.abc import AsyncIterator, Callable

import pytest

from abbe.drivers.api import BarBatch, BarSample
from abbe.drivers.ballbar import driver as module
from abbe.drivers.ballbar.driver import SerialBallBar
from abbe.drivers.ballbar.stream import Reads, Stream
from abbe.drivers.errors import Backpressure, LossyLine
from abbe.drivers.links.reading import ReadingThread, Ring
from abbe.drivers.links.serial_link import ByteLink
from abbe.drivers.links.urls import parse_url
from tests.drivers.contract.conftest import bar_peer as bar_peer  # fixture
from tests.patience import within


def test_a_ring_tells_its_marks_once_and_counts_what_found_no_room() -> None:
    ring, marks = Ring(1000), []
    ring.on_mark = marks.append
    for _ in range(12):
        ring.put(1.0, b"x" * 90)
    assert marks == [0.5, 0.8, 1.0]
    assert (ring.lost_bytes, ring.highest) == (90, 1.0)
    assert ring.fill == pytest.approx(0.99)
    taken = ring.take(0.0)
    assert taken is not None
    assert [len(piece.data) for piece in taken] == [90] * 11
    ring.put(2.0, b"y")
    (piece,) = ring.take(0.0) or []
    assert (piece.lost_before, piece.host_s) == (90, 2.0)  # the loss stands where it happened
    for _ in range(6):
        ring.put(3.0, b"x" * 90)
    assert marks == [0.5, 0.8, 1.0, 0.5]  # it was empty in between


def test_a_ring_ends_after_its_last_byte() -> None:
    ring = Ring(100)
    ring.put(1.0, b"abc")
    ring.end()
    assert [piece.data for piece in ring.take(1.0) or []] == [b"abc"]
    assert ring.take(1.0) is None


def test_the_thread_reads_until_it_is_stopped_and_leaves_no_descriptor_open() -> None:
    before = set(os.listdir("/proc/self/fd"))
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(slave, False)
    ring, lost = Ring(1 << 20), []
    thread = ReadingThread(slave, ring, lost.append, "pty")
    os.write(master, b"hello")
    pieces = ring.take(5.0)
    assert pieces
    assert b"".join(piece.data for piece in pieces) == b"hello"
    thread.stop()
    thread.stop()
    assert ring.take(1.0) is None
    assert lost == []
    os.close(master)
    os.close(slave)
    assert set(os.listdir("/proc/self/fd")) <= before


def test_the_thread_tells_that_the_device_has_gone() -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(slave, False)
    ring, gone = Ring(1 << 20), threading.Event()
    thread = ReadingThread(slave, ring, lambda error: gone.set(), "pty")
    os.close(master)
    assert gone.wait(within(5.0))
    assert ring.take(1.0) is None
    thread.stop()
    os.close(slave)


class SlowTap:
    """A disk that hangs until somebody frees it."""

    def __init__(self) -> None:
        self.free = threading.Event()
        self.entered = threading.Event()
        self.taken: list[BarBatch] = []
        self.warnings: list[str] = []

    def take(self, batch: BarBatch) -> None:
        self.entered.set()
        self.free.wait(within(20.0))
        self.taken.append(batch)

    def warn(self, text: str) -> None:
        self.warnings.append(text)

    @property
    def seqs(self) -> list[int]:
        return [sample.seq for batch in self.taken for sample in batch.samples]


@pytest.fixture
async def short_bar(bar_peer) -> AsyncIterator[SerialBallBar]:
    """A driver whose ring holds 100,000 bytes: 4 166 samples."""
    opened = SerialBallBar(ByteLink(parse_url(bar_peer.url)), ring_s=100_000 / 24_000)
    yield opened
    await opened.close()


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(within(10)):
        while not condition():  # noqa: ASYNC110 - it comes true in a thread
            await asyncio.sleep(0.005)


async def hang(bar_peer, tap: SlowTap) -> None:
    """Let the tap hang in the very first sample: from then on everything stays in the ring."""
    bar_peer.send(bar_peer.sample(0))
    await until(tap.entered.is_set)


async def pour(bar_peer, count: int, begin: int = 0) -> None:
    """Samples begin to count-1, as fast as the line takes them."""
    for first in range(begin, count, 100):
        bar_peer.send(b"".join(bar_peer.sample(k) for k in range(first, min(first + 100, count))))
        await asyncio.sleep(0.001)


async def test_a_disk_that_hangs_stops_the_machine_at_80_percent_and_costs_nothing(bar_peer, short_bar) -> None:
    tap = SlowTap()
    async with short_bar.stream(1000, tap) as batches:
        await hang(bar_peer, tap)
        pouring = asyncio.create_task(pour(bar_peer, 4000, 1))
        async with asyncio.timeout(within(10)):
            with pytest.raises(Backpressure, match=r"(8|9)\d% full|100% full") as caught:
                await anext(batches)
        assert caught.value.code == "DRV-009"
        assert tap.warnings == [f"the ring between reading and storing is {mark}% full" for mark in (50, 80)]
        await pouring
        tap.free.set()
    assert tap.seqs == list(range(4000))  # the reason to stop came before anything was lost
    assert all(batch.missing == 0 for batch in tap.taken)


async def test_a_full_ring_is_an_explicit_gap(bar_peer, short_bar) -> None:
    tap = SlowTap()
    with pytest.raises(LossyLine):  # and the run ends, whatever the consumer makes of the first error
        await overfill(bar_peer, short_bar, tap)
    assert any("100% full" in text for text in tap.warnings)
    gaps = [batch for batch in tap.taken if batch.missing]
    assert gaps
    assert gaps[0].overran
    assert len(tap.seqs) + sum(batch.missing for batch in gaps) == 8010


async def overfill(bar_peer, bar: SerialBallBar, tap: SlowTap) -> None:
    async with bar.stream(1000, tap) as batches:
        await hang(bar_peer, tap)
        pouring = asyncio.create_task(pour(bar_peer, 8000, 1))
        with pytest.raises(Backpressure):
            await anext(batches)
        await pouring
        assert bar._framing is not None
        assert bar._framing.ring.lost_bytes > 0
        tap.free.set()
        await until(lambda: not bar.backlog)
        await pour(bar_peer, 8010, 8000)
        await until(lambda: tap.seqs[-1] >= 8009)


async def test_a_consumer_who_never_looks_stops_the_machine_but_every_sample_is_taken(bar_peer, monkeypatch) -> None:
    monkeypatch.setattr(module, "_BUFFER_S", 1.0)
    bar = SerialBallBar(ByteLink(parse_url(bar_peer.url)))
    tap = SlowTap()
    tap.free.set()
    async with bar.stream(1000, tap) as batches:
        await pour(bar_peer, 3000)
        await until(lambda: len(tap.seqs) >= 3000)
        with pytest.raises(Backpressure, match=r"(8|9)\d% full|100% full"):
            await anext(batches)
    assert tap.seqs == list(range(3000))
    await bar.close()


async def test_a_last_reading_that_jumps_is_not_left_out() -> None:
    """The gate of the slew keeps it until the next one tells; when no next one comes, it is kept as it came."""
    tap = SlowTap()
    tap.free.set()
    stream = Stream("bar", 1000, 30.0, tap, 1, reads=Reads(0, 1_000_000))
    samples = [BarSample(k, 1000 * (k + 1), 0 if k < 9 else 900_000, 8) for k in range(10)]
    stream.put(1.0, samples, overran=False)
    assert tap.seqs == list(range(9))
    stream.leave()
    stream.finish()
    stream.finish()
    assert tap.seqs == list(range(10))


async def test_a_busy_event_loop_costs_no_sample(bar_peer) -> None:
    """The loop does nothing else for a second; the kernel's buffer holds a tenth of what comes meanwhile."""
    bar = SerialBallBar(ByteLink(parse_url(bar_peer.url)))
    tap = SlowTap()
    tap.free.set()
    async with bar.stream(1000, tap):
        frames = [b"".join(bar_peer.sample(k) for k in range(first, first + 100)) for first in range(0, 8000, 100)]

        def write_all() -> None:
            for frame in frames:
                rest = memoryview(frame)
                while rest:
                    try:
                        rest = rest[os.write(bar_peer.master, rest) :]
                    except BlockingIOError:
                        threading.Event().wait(0.001)

        writing = threading.Thread(target=write_all)
        writing.start()
        writing.join(20.0)  # blocks the event loop until everything is written
        assert not writing.is_alive()
        await until(lambda: len(tap.seqs) >= 8000)
    assert tap.seqs == list(range(8000))
    await bar.close()
