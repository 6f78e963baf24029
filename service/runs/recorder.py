"""From samples to the database, at most a few tens of milliseconds behind the device.

The recorder only buffers and writes. A chunk is committed as soon as `FLUSH_S` wall seconds have passed since the last; what a killed
process leaves behind is every chunk committed before, and a run without an end: visibly incomplete.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from drivers.api import BarBatch, BarSample
from drivers.links.shielded import run_to_end
from service.runs.codec import BAR_CODEC, JSON_CODEC, encode_bar, encode_json
from service.storage.store import Store

FLUSH_S = 0.03


class Recorder:
    """Buffers what one run produces and appends it as immutable chunks."""

    def __init__(self, store: Store, run_id: int) -> None:
        self._store = store
        self._run = run_id
        self._bar: list[BarSample] = []
        self._bar_host: list[float] = []
        self._records: list[dict[str, Any]] = []
        self._seq = {"bar": 0, "laser": 0}
        self._loop = asyncio.get_running_loop()
        self._flushed_s = self._loop.time()
        self.gaps: list[dict[str, int]] = []

    async def add_bar(self, batch: BarBatch) -> None:
        """Take a batch of ball-bar samples; what the sequence numbers miss becomes an explicit gap."""
        if batch.missing:
            self.gaps.append({"before_seq": batch.samples[0].seq if batch.samples else -1, "missing": batch.missing})
        self._bar.extend(batch.samples)
        self._bar_host.append(batch.host_s)
        await self._flush_when_due()

    async def add_record(self, record: dict[str, Any]) -> None:
        """Take one laser record."""
        self._records.append(record)
        await self._flush_when_due()

    async def _flush_when_due(self) -> None:
        if self._loop.time() - self._flushed_s >= FLUSH_S:
            await self.flush()

    async def flush(self) -> None:
        """Commit what is buffered."""
        self._flushed_s = self._loop.time()
        if self._bar:
            samples, hosts = self._bar, self._bar_host
            self._bar, self._bar_host = [], []
            span = (hosts[0], hosts[-1], samples[0].device_us, samples[-1].device_us)
            await self._append("bar", len(samples), BAR_CODEC, encode_bar(samples), span)
        if self._records:
            records, self._records = self._records, []
            first, last = records[0], records[-1]
            span = (first["host_s"], last["host_s"], first["ctrl_us"], last["ctrl_us"])
            await self._append("laser", len(records), JSON_CODEC, encode_json(records), span)

    async def _append(self, channel: str, n: int, codec: str, payload: bytes, span: tuple[float, float, int, int]) -> None:
        seq = self._seq[channel]
        self._seq[channel] += 1
        await self._store.write(self._store.append_chunk, self._run, channel, seq, n, codec, payload, *span)


@asynccontextmanager
async def recording(store: Store, run_id: int) -> AsyncIterator[Recorder]:
    """A recorder for one run; what is still buffered is committed at the end, also when the block fails or is cancelled."""
    recorder = Recorder(store, run_id)
    try:
        yield recorder
    finally:
        await run_to_end(recorder.flush())
