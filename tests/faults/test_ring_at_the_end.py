"""Samples that have arrived and wait in the ring when a run ends by an error are stored, or the run says that it is not whole."""

from __future__ import annotations

import asyncio
import threading
from pathlib import Path

import pytest

from abbe.drivers.api import BarBatch
from abbe.drivers.ballbar import driver
from abbe.drivers.errors import Backpressure, LinkDown
from abbe.drivers.links.reading import ReadPiece
from abbe.service.capture.recorder import CaptureRecorder, close_run, recording
from abbe.service.capture.recovery import ledger_of
from abbe.service.capture.settings import CaptureSettings
from abbe.service.clock import SystemClock
from abbe.service.runs.chunks import decode_bar
from abbe.service.storage.store import Store
from tests.faults.serial_rig import Stage, Tap, stage
from tests.patience import within
from tests.service.capture.capture_bench import new_run

SENT = 400


class SlowTap(Tap):
    """Lets nothing through until it may: everything that arrives meanwhile waits in the ring."""

    def __init__(self, inner: object = None) -> None:
        super().__init__()
        self.reached, self.may = threading.Event(), threading.Event()
        self._inner = inner

    def take(self, batch: BarBatch) -> None:
        self.reached.set()
        self.may.wait(within(30.0))
        super().take(batch)
        if self._inner is not None:
            self._inner.take(batch)  # type: ignore[attr-defined]


async def sent_and_pulled(on: Stage, tap: SlowTap) -> None:
    """All samples are sent and have arrived, the first of them waits at the tap, and the cable is pulled."""
    await on.box.run(1)
    await asyncio.to_thread(tap.reached.wait, 10.0)
    await on.box.run(SENT)
    ring = on.bar._framing.ring
    async with asyncio.timeout(within(10.0)):
        while ring._bytes < SENT * 24:  # noqa: ASYNC110 - what waits in the ring is what is tested
            await asyncio.sleep(0.001)
    taken = ring.take

    def late(timeout_s: float) -> list[ReadPiece] | None:
        pieces = taken(timeout_s)
        threading.Event().wait(0.2)  # a thread that gets no processor: whoever ends the stream now could be before it
        return pieces

    ring.take = late
    on.box.line.pull()
    asyncio.get_running_loop().call_later(0.2, tap.may.set)  # long after the consumer has heard of it


async def streamed(on: Stage, tap: SlowTap) -> None:
    """A stream that is ended by the loss of the line."""
    async with on.bar.stream(1000, tap) as batches:
        script = asyncio.create_task(sent_and_pulled(on, tap))
        try:
            async for _ in batches:
                pass
        finally:
            await script


async def test_what_waits_in_the_ring_when_the_line_is_lost_gets_to_the_tap(tmp_path: Path) -> None:
    async with stage(tmp_path, "ring", "line lost") as on:
        await on.bar.identify()
        tap = SlowTap()
        with pytest.raises(LinkDown):
            await streamed(on, tap)
        sent = [sample.seq for sample in on.box.sent[on.box.stream]]
        assert len(sent) >= SENT
        assert [sample.seq for sample in tap.samples] == sent


async def test_and_into_the_runs_account_with_an_open_gap_behind_it(tmp_path: Path) -> None:
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        run_id = new_run(store)
        async with stage(tmp_path, "ring", "account") as on:
            await on.bar.identify()
            held: list[CaptureRecorder] = []
            with pytest.raises(LinkDown):  # noqa: PT012 - both ends of the recording belong to it
                async with recording(store, run_id, CaptureSettings(reserve_bytes=65536), SystemClock()) as recorder:
                    held.append(recorder)
                    await streamed(on, SlowTap(recorder.tap()))
            await close_run(store, run_id, held[0], "failed", "DRV-002: cable", held[0].doc())
            sent = [sample.seq for sample in on.box.sent[on.box.stream]]
        chunks = store.chunks.of_run(run_id)
        stored = [sample.seq for chunk in chunks if chunk.channel == "bar" for sample in decode_bar(chunk.payload)]
        assert stored == sent
        ledger = ledger_of(chunks)
        assert (ledger.unaccounted(), ledger.duplicates()) == ([], 0)
        (gap,) = ledger.gaps
        assert (gap.first, gap.last) == (sent[-1] + 1, None)
        assert "the device is gone" in gap.cause


async def test_a_tap_that_never_takes_it_fails_a_run_that_ended_well(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver, "_DRAIN_S", 0.1)
    monkeypatch.setattr("abbe.drivers.ballbar.frames._DRAIN_S", 0.1)
    monkeypatch.setattr(driver, "_ANSWER_S", 0.1)
    async with stage(tmp_path, "ring", "never") as on:
        await on.bar.identify()
        tap = SlowTap()
        with pytest.raises(Backpressure, match="not stored"):  # noqa: PT012 - it comes at the end of the block
            async with on.bar.stream(1000, tap):
                await on.box.run(SENT)
                await asyncio.to_thread(tap.reached.wait, 10.0)
                asyncio.get_running_loop().call_later(1.0, tap.may.set)
        assert on.bar.incidents.entries[-1].code == Backpressure.code
