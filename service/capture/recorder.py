"""The recorder of real runs: samples go from the driver's thread to the segment, and from there to the database.

Every item reaches the disk within tens of milliseconds (`CaptureLog`), in a thread of its own. Neither the event loop nor the database
nor a solver can delay this thread. The disk can: then `CaptureLog.put` waits and the ring of the driver fills, which stops the machine
before a sample is lost.
"""

from __future__ import annotations

import asyncio
import os
import threading
import time
from collections.abc import AsyncIterator, Callable
from contextlib import ExitStack, asynccontextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from abbe.drivers.api import BarBatch
from abbe.drivers.errors import run_to_end
from abbe.service.capture.ingest import Ingest
from abbe.service.capture.ledger import BAR, Drafter, Item, SampleGap, joined, streams_doc
from abbe.service.capture.segment import CHUNK, GAP, FileIO, RealFileIO, Record, Reserve, Segment, fault
from abbe.service.capture.settings import ORPHAN, CaptureSettings, folder_of, is_memory, segment_path, set_aside
from abbe.service.clock import Clock
from abbe.service.errors import AbbeError, CaptureFault, DiskFull, StoreError
from abbe.service.storage.store import Store

GROUP_S = 0.01
"""Longest time, s, that a sample waits to share a sync with later samples; the wait for an earlier slow sync counts."""
MAX_PENDING = 8192
HANG_S = 30.0

Published = Callable[[str, int, int], None]
"""Called in the capture's thread with channel, stream and highest durable sequence number."""


class CaptureLog:
    """Writes one run's segment, which must be new and empty.

    ``opening``: content of the first record. ``durable`` is called with offset and length of every record that reached the disk,
    ``published`` when more samples are durable.
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
        """Take note that the database's disk is full: the run ends while the segment still has space."""
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
                self.error = self.error or CaptureFault(f"the capture could not be ended: {error!r}", "report this as a defect of Abbe")

    @property
    def hangs(self) -> bool:
        """Whether the disk did not answer during `close`, so that the state of the file is unknown."""
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
                self.error = CaptureFault(f"the capture failed: {error!r}", "report this as a defect of Abbe")
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
        """Append. If the disk is full, release the reserve, append again and return the DiskFull error; else return None."""
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
        """Gaps in the samples so far."""
        return list(self.drafter.ledger.gaps)


CATCH_UP_S = 120.0
LASER = "laser"

_active: set[tuple[str, int]] = set()


def _key(path: Path) -> tuple[str, int]:
    return str(path), os.getpid()


def is_active(path: Path) -> bool:
    """Whether this process records into a segment, or has not closed its run yet."""
    return _key(path) in _active


Look = Callable[[BarBatch], None]
"""Receives every recorded batch in the driver's thread; must neither wait nor raise."""


def ignore_batch(_: BarBatch) -> None:
    """Ignore the batch: there is no live view."""


class _Tap:
    def __init__(self, log: CaptureLog, stream: int, look: Look) -> None:
        self._log, self._stream, self._look = log, stream, look

    def take(self, batch: BarBatch) -> None:
        self._log.put((self._stream, batch))
        self._look(batch)

    def warn(self, text: str) -> None:
        self._log.warnings.append(text)


class CaptureRecorder:
    """Records one run. Open it with `recording`.

    ``behind``: whether the segment has records that the database lacks. A segment that is still behind at the end is kept: the next start
    recovers the run from it.
    """

    def __init__(self, log: CaptureLog, ingest: Ingest, keep: bool, io: FileIO, *, temporary: bool = False) -> None:
        self.log, self.ingest = log, ingest
        self._temporary = temporary
        self.behind = True
        self._keep, self._io = keep, io
        self._streams = 0
        self.look: Look = ignore_batch
        """The live view; set before a stream begins."""

    def tap(self) -> _Tap:
        """Return the receiver of every sample of a new stream."""
        self._streams += 1
        return _Tap(self.log, self._streams - 1, self.look)

    async def add_bar(self, batch: BarBatch) -> None:
        """Check the capture after a batch of the ball-bar; the tap has queued its samples. Raises like `check`."""
        self.check()

    async def add_record(self, record: dict[str, Any]) -> None:
        """Queue one record of the laser; raises like `check`."""
        self.check()
        self.log.put((LASER, record))

    async def flush(self) -> None:
        """Wait until everything queued so far is on the disk; raises like `check`."""
        await asyncio.to_thread(self.log.flush)
        self.check()

    def check(self) -> None:
        """Raise the error of a thread, if there is one.

        Raises
        ------
        DiskFull, CaptureFault, CaptureConflict
            Samples are not safe any more: the machine has to stop.
        """
        error = self.log.error or self.ingest.error
        if error is not None:
            raise error

    @property
    def durable_seq(self) -> int:
        """Last ball-bar sample of the current stream that survives a kill and a power cut; -1: none yet."""
        return self.log.durable.get(BAR, (0, -1))[1]

    def close(self, status: str, reason: str) -> None:
        """End the segment and wait for the database. Blocks. Only a complete transfer clears ``behind``."""
        self.behind, taken = True, False
        try:
            self.log.close({"status": status, "reason": reason}, "" if status == "complete" else reason)
        finally:
            taken = self.ingest.finish(CATCH_UP_S)
            self.behind = not taken or self.log.hangs

    def doc(self) -> dict[str, Any]:
        """Return the account of the samples for the end document."""
        log = self.log
        capture = log.drafter.ledger.doc() | {
            "records": log.segment.records,
            "head_sha256": log.segment.head.hex(),
            "warnings": log.warnings,
            "streams": log.streams,
        }
        return {"gaps": [gap.doc() for gap in log.gaps], "capture": capture}

    def discard(self) -> None:
        """Delete the segment: the database has everything and the run is closed there."""
        if not self._keep:
            with suppress(OSError):  # the next start finds all of it in the database
                self._io.remove(self.log.segment.path)
        if self._temporary:
            with suppress(OSError):  # the folder may hold other runs
                self.log.segment.path.parent.rmdir()

    def release(self) -> None:
        """Let this process recover the segment like any other segment; until this call `is_active` protects it."""
        _active.discard(_key(self.log.segment.path))


async def close_run(store: Store, run_id: int, recorder: CaptureRecorder | None, status: str, reason: str, end: dict[str, Any]) -> None:
    """Close a run in the database and delete its segment; a run with samples missing there stays open and visibly incomplete.

    ``recorder`` must have ended; None: there was no recording.

    Raises
    ------
    StoreError
        The database refuses the end. The segment stays, and the next start closes the run.
    """
    try:
        if recorder is not None and recorder.behind:
            return  # the next start recovers the segment and closes the run
        await store.write(store.runs.finish, run_id, status, reason, end)
        if recorder is not None:
            recorder.discard()
    finally:
        if recorder is not None:
            recorder.release()


@asynccontextmanager
async def recording(
    store: Store,
    run_id: int,
    settings: CaptureSettings,
    clock: Clock,
    about: dict[str, Any] | None = None,
    *,
    io: FileIO | None = None,
    published: Published = lambda channel, stream, seq: None,
) -> AsyncIterator[CaptureRecorder]:
    """Open a recorder for one run and close it after the block.

    Parameters
    ----------
    clock : Clock
        For the UTC offset that is stored with every chunk; no sample time depends on it.
    about : dict, optional
        Description of the run, for the segment's first record.
    published : callable, optional
        Called in the capture's thread whenever more samples are durable.

    Raises
    ------
    DiskFull, CaptureFault
        Before anything moves: nothing can be written. At the end: some samples are not safe.
    StoreError
        At the end: the database did not take everything in time. The segment keeps it, and the next start catches up.
    """
    recorder = await _opened_or_closed(lambda: _opened(store, run_id, settings, clock, about or {}, io or RealFileIO(), published))
    status, reason = "failed", "stopped"
    try:
        yield recorder
        status, reason = "complete", ""
    except BaseException as error:
        reason = str(error) or type(error).__name__
        raise
    finally:
        await run_to_end(asyncio.to_thread(recorder.close, status, reason))
    recorder.check()
    if recorder.behind:
        raise StoreError(
            f"the database did not take all samples within {CATCH_UP_S:g} s; they are safe in {recorder.log.segment.path}",
            "check the database; the next `abbe` command that connects to the machine stores the samples in the database",
        )


async def _opened_or_closed(work: Callable[[], CaptureRecorder]) -> CaptureRecorder:
    """Open a recorder; close it again if the caller is cancelled meanwhile."""
    found: list[CaptureRecorder] = []

    async def opening() -> None:
        found.append(await asyncio.to_thread(work))

    try:
        await run_to_end(opening())
    except BaseException:
        for one in found:
            await run_to_end(asyncio.to_thread(one.close, "failed", ""))  # without a measurement there is no gap
            one.release()
        raise
    return found[0]


def _opened(
    store: Store, run_id: int, settings: CaptureSettings, clock: Clock, about: dict[str, Any], io: FileIO, published: Published
) -> CaptureRecorder:
    folder = folder_of(store, settings)
    temporary = is_memory(store.url) and not settings.folder
    reserve = Reserve(io, folder, 0 if temporary else settings.reserve_bytes)
    opening = about | {"run": run_id, "utc": clock.utc().isoformat(), "started_utc": store.runs.find(run_id).started_utc}
    _make(folder, io)
    reserve.allocate()
    path = segment_path(folder, run_id)
    _active.add(_key(path))  # before a recovery could find the file
    try:
        if path.exists():  # left by a deleted database, whose run numbers are used again
            set_aside(path, ORPHAN)
        drafter = Drafter(run_id, lambda: clock.utc().timestamp() - clock.monotonic_s())
        log, ingest = _begun(store, Segment(io, path), drafter, reserve, opening, published)
    except BaseException as error:
        _active.discard(_key(path))
        if isinstance(error, OSError):
            raise fault(path, "open the segment", error) from error
        raise
    return CaptureRecorder(log, ingest, settings.keep, io, temporary=temporary)


def _make(folder: Path, io: FileIO) -> None:
    """Create a folder so that every new level survives a power cut."""
    made = [one for one in (folder, *folder.parents) if not one.exists()] or [folder]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for one in reversed(made):
            io.sync_folder(one.parent)
    except OSError as error:
        raise fault(folder, "make the folder", error) from error


def _begun(
    store: Store, segment: Segment, drafter: Drafter, reserve: Reserve, opening: dict[str, Any], published: Published
) -> tuple[CaptureLog, Ingest]:
    """Start both threads of a recording; if one fails, end both and close the segment."""
    logs: list[CaptureLog] = []
    with ExitStack() as undo:
        undo.callback(segment.close)
        ingest = Ingest(store, segment.path, lambda: logs[0].disk_full() if logs else None)
        undo.callback(ingest.finish, 0.0)
        logs.append(CaptureLog(segment, drafter, reserve, opening, ingest.add, published))
        undo.pop_all()
    return logs[0], ingest
