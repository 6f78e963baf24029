"""The capture of one run: whatever is given to it is on the disk a few tens of milliseconds later, then on its way to the database.

It has a thread of its own. Nothing in the event loop, the database or a solver can hold it up; the disk can, and then `take` waits and the
driver's ring fills up, which stops the machine before a sample is lost.
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
"""So long after its arrival the first sample waits for company, so that a group costs one sync. No longer: what it waited before counts, be
it for its framing or for a slow sync."""
MAX_PENDING = 8192
HANG_S = 30.0

Published = Callable[[str, int, int], None]
"""Channel, stream and highest sequence number that is durable; called in the capture's thread."""


class CaptureLog:
    """Writes one run's segment.

    Parameters
    ----------
    segment : Segment
        New and empty.
    drafter : Drafter
        Of this run.
    reserve : Reserve
        Disk space for the end.
    opening : dict
        What the first record says.
    durable : callable
        Called with the places of every record that is on the disk now.
    published : callable
        Called when ``durable_seq`` has risen.
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
        """For each channel stream and sequence number up to which everything survives a kill and a power cut."""
        self.warnings: list[str] = []
        self.streams: list[list[int]] = []
        """Of which stream the ball-bar's chunks are, as `streams_doc` has it."""
        self._reserve, self._durable, self._published = reserve, durable, published
        self._pending: list[Item] = []
        self._samples = 0
        self._first_s = 0.0
        self._given = self._stored = 0
        self._closing = self._hurry = False
        self._full = False
        self._dropped: dict[int, int] = {}
        """Of each stream the last number that did not get onto the disk."""
        self._news = threading.Condition()
        self._append([drafter.opening(opening)], [])
        self._thread = threading.Thread(target=self._run, name="abbe-capture", daemon=True)
        self._thread.start()

    def put(self, item: Item) -> None:
        """Take a batch or a record, from any thread; waits while the disk is far behind. Never raises: see ``error``."""
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
                self._news.notify_all()  # joining a group does not wake the writer

    def flush(self) -> None:
        """Wait until everything given so far is on the disk, or never will be. Blocks."""
        with self._news:
            goal = self._given
            self._hurry = True
            self._news.notify_all()
            self._news.wait_for(lambda: self._stored >= goal or not self._thread.is_alive())

    def disk_full(self) -> None:
        """The database found no space: end the run while there still is some for the segment."""
        with self._news:
            self._full = True
            self._news.notify_all()

    def close(self, doc: dict[str, Any], cause: str) -> None:
        """Write what is left and the closing record, and end the thread. Blocks.

        Parameters
        ----------
        doc : dict
            How the run ended.
        cause : str
            Why samples after the last one may be missing; empty when the stream ended in order.
        """
        with self._news:
            self._closing = True
            self._news.notify_all()
        self._thread.join(HANG_S)
        if self.hangs:
            self.error = self.error or self._hangs()
            return  # its thread may still be in the file: leave it alone; the next start sees how far it got
        for step in (partial(self._write_end, doc, cause), self.segment.close):
            try:
                step()
            except AbbeError as error:
                self.error = self.error or error
            except Exception as error:  # noqa: BLE001 - whatever it is, the run was not ended in order and must not look so
                self.error = self.error or CaptureFault(f"the capture could not be ended: {error!r}", "report this")

    @property
    def hangs(self) -> bool:
        """After `close`: the disk still has not answered, and what it does with the file is not known."""
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
        if self._dropped:  # numbers that came after the disk had given up
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
            except Exception as error:  # noqa: BLE001 - a thread that dies in silence would hold the tap for ever
                self.error = CaptureFault(f"the capture could not go on: {error!r}", "report this")
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
        """Append, if need be on the reserve's space; then says that the disk is full, with everything acknowledged."""
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
