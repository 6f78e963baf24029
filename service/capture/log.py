"""The capture of one run: every item reaches the disk within tens of milliseconds, and then goes to the database.

It has a thread of its own, which the event loop, the database or a solver cannot delay. The disk can: then `put` waits and the ring of the
driver fills, which stops the machine before a sample is lost.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from abbe.drivers.api import BarBatch
from abbe.service.capture.ledger import Drafter, Item, SampleGap, joined, streams_doc
from abbe.service.capture.segment import CHUNK, GAP, Record, Reserve, Segment
from abbe.service.errors import AbbeError, CaptureFault, DiskFull

GROUP_S = 0.01
"""Longest wait of a sample after its arrival, so that a group shares one sync. Earlier waits (for framing or a slow sync) count."""
MAX_PENDING = 8192
HANG_S = 30.0

Published = Callable[[str, int, int], None]
"""Called in the capture's thread with channel, stream and highest durable sequence number."""


class CaptureLog:
    """Writes one run's segment, which must be new and empty.

    ``opening``: content of the first record. ``durable`` is called with offset and length of every record that reached the disk,
    ``published`` when ``durable_seq`` has risen.
    """

    def __init__(
        self,
        segment: Segment,
        drafter: Drafter,
        reserve: Reserve,
        opening: dict[str, Any],
        durable: Callable[[list[tuple[int, int]]], None],
        published: Published = lambda channel, stream, seq: None,
    ) -> None:
        self.segment, self.drafter = segment, drafter
        self.error: AbbeError | None = None
        self.durable: dict[str, tuple[int, int]] = {}
        """For each channel the stream and the last sequence number that survives a kill and a power cut."""
        self.warnings: list[str] = []
        self.streams: list[list[int]] = []
        """Streams of the ball-bar's chunks, in the form of `streams_doc`."""
        self._reserve, self._durable, self._published = reserve, durable, published
        self._pending: list[Item] = []
        self._samples = 0
        self._first_s = 0.0
        self._given = self._stored = 0
        self._closing = self._hurry = False
        self._full = False
        self._dropped: dict[int, int] = {}
        """For each stream the last number that did not reach the disk."""
        self._news = threading.Condition()
        self._append([drafter.opening(opening)], [])
        self._thread = threading.Thread(target=self._run, name="abbe-capture", daemon=True)
        self._thread.start()

    def put(self, item: Item) -> None:
        """Queue a batch or a record, from any thread; waits while the disk is far behind. Never raises: see ``error``."""
        with self._news:
            room = self._news.wait_for(lambda: self._samples < MAX_PENDING or self._closing or self.error is not None, HANG_S)
            if self._closing:
                return
            if not room:
                self.error = self._hangs()
            first = not self._pending
            if first:
                now_s = time.monotonic()
                self._first_s = min(item[1].host_s, now_s) if isinstance(item[1], BarBatch) else now_s
            self._pending.append(item)
            self._given += 1
            self._samples += len(item[1].samples) if isinstance(item[1], BarBatch) else 1
            if first or self._samples >= MAX_PENDING:
                self._news.notify_all()  # further items of a group need not wake the writer

    def flush(self) -> None:
        """Block until everything queued so far is on the disk, or the capture has failed."""
        with self._news:
            goal = self._given
            self._hurry = True
            self._news.notify_all()
            self._news.wait_for(lambda: self._stored >= goal or not self._thread.is_alive())

    def disk_full(self) -> None:
        """Report a full database disk: end the run while the segment still has space."""
        with self._news:
            self._full = True
            self._news.notify_all()

    def close(self, doc: dict[str, Any], cause: str) -> None:
        """Write the rest and the closing record ``doc``, and end the thread. Blocks.

        ``cause``: why samples after the last one may be missing; empty after an orderly end of the stream.
        """
        with self._news:
            self._closing = True
            self._news.notify_all()
        self._thread.join(HANG_S)
        if self.hangs:
            self.error = self.error or self._hangs()
            return  # the thread may still use the file: leave it alone; the next start recovers it
        for step in (partial(self._write_end, doc, cause), self.segment.close):
            try:
                step()
            except AbbeError as error:
                self.error = self.error or error
            except Exception as error:  # noqa: BLE001 - the run did not end in order and must not look so
                self.error = self.error or CaptureFault(f"the capture could not be ended: {error!r}", "report this")

    @property
    def hangs(self) -> bool:
        """After `close`: whether the disk has not answered, so that the state of the file is unknown."""
        return self._thread.is_alive()

    def _hangs(self) -> CaptureFault:
        return CaptureFault(f"{self.segment.path}: the disk has not answered for {HANG_S:g} s", "look at the disk")

    def _write_end(self, doc: dict[str, Any], cause: str) -> None:
        last = self._final_gaps(cause)
        if self.segment.dead:
            self.drafter.book([], last)
            last = []
        sums = {"durable": self.durable, "ledger": self.drafter.ledger.doc(), "warnings": self.warnings}
        self._append_or_release([*last, self.drafter.closing(doc | sums)], [])

    def _final_gaps(self, cause: str) -> list[Record]:
        if self._dropped:  # numbers that came after the disk had failed
            return [self.drafter.lost(str(self.error), last, None, stream) for stream, last in self._dropped.items()]
        return [self.drafter.lost(cause, None, None)] if cause else []

    def _run(self) -> None:
        while True:
            with self._news:
                self._news.wait_for(lambda: self._pending or self._closing or self._full)
                rest_s = self._first_s + GROUP_S - time.monotonic()
                if rest_s > 0.0:
                    self._news.wait_for(lambda: self._closing or self._hurry or self._samples >= MAX_PENDING, rest_s)
                items, self._pending = self._pending, []
                full, self._full = self._full, False
                self._hurry = False
                self._samples = 0
                self._news.notify_all()
                if not items and self._closing:
                    return
            self._store(items)
            if full:
                self._end_for_want_of_space()
            with self._news:
                self._stored += len(items)
                self._news.notify_all()

    def _store(self, items: list[Item]) -> None:
        if self.error is None:
            try:
                self._safely(items)
                return
            except AbbeError as error:
                self.error = error
            except Exception as error:  # noqa: BLE001 - a silent end of the thread would block the tap for ever
                self.error = CaptureFault(f"the capture failed: {error!r}", "report this")
        self._drop(items)

    def _end_for_want_of_space(self) -> None:
        self._reserve.release()
        if self.error is None:
            self.error = DiskFull("the database has no disk space left", "free disk space, then measure this test again")

    def _safely(self, items: list[Item]) -> None:
        before = self.drafter.mark()
        try:
            full = self._append_or_release(self.drafter.drafts(items), items)
            self.error = self.error or full
        except Exception:
            self.drafter.reset(before)
            raise

    def _append_or_release(self, records: list[Record], items: list[Item]) -> DiskFull | None:
        """Append, using the reserve if necessary; return the DiskFull error if it was used."""
        try:
            self._append(records, items)
        except DiskFull as error:
            if self.segment.dead or not self._reserve.release():
                raise
            self._append(records, items)
            return error
        return None

    def _drop(self, items: list[Item]) -> None:
        for stream, batch in items:
            if isinstance(batch, BarBatch) and batch.samples:
                self._dropped[int(stream)] = batch.samples[-1].seq

    def _append(self, records: list[Record], items: list[Item]) -> None:
        if not records:
            return
        places = self.segment.append(records)
        self.drafter.book(items, [record for record in records if record.kind == GAP])
        self.streams = joined(self.streams, streams_doc(records))
        self._durable(places)
        for record in records:
            if record.kind == CHUNK:
                self.durable[record.channel] = (record.stream, record.first_seq + record.count - 1)
                self._published(record.channel, *self.durable[record.channel])

    @property
    def gaps(self) -> list[SampleGap]:
        """Gaps so far."""
        return list(self.drafter.ledger.gaps)
