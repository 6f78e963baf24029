"""The recorder of real runs: samples go from the driver's thread to the segment, and from there to the database."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator, Callable
from contextlib import ExitStack, asynccontextmanager, suppress
from pathlib import Path
from typing import Any

from abbe.drivers.api import BarBatch
from abbe.drivers.links.shielded import run_to_end
from abbe.service.capture.file_io import FileIO, RealFileIO
from abbe.service.capture.ingest import Ingest
from abbe.service.capture.ledger import BAR, Drafter
from abbe.service.capture.log import CaptureLog, Published
from abbe.service.capture.segment import Reserve, Segment, fault
from abbe.service.capture.settings import ORPHAN, CaptureSettings, folder_of, is_memory, segment_path, set_aside
from abbe.service.clock import Clock
from abbe.service.errors import StoreError
from abbe.service.storage.store import Store

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
    """No live view."""


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

    ``behind``: the segment has records that the database lacks; after the end it must stay, and the run open, for the next start.
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
        """Return the tap that takes every sample of a new stream."""
        self._streams += 1
        return _Tap(self.log, self._streams - 1, self.look)

    async def add_bar(self, batch: BarBatch) -> None:
        """Check the capture after a batch that the tap has taken; raises as `check`."""
        self.check()

    async def add_record(self, record: dict[str, Any]) -> None:
        """Queue one record of the laser; raises as `check`."""
        self.check()
        self.log.put((LASER, record))

    async def flush(self) -> None:
        """Wait until everything queued so far is on the disk; raises as `check`."""
        await asyncio.to_thread(self.log.flush)
        self.check()

    def check(self) -> None:
        """Raise an error of the threads.

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
        """Let this process recover the segment like any other; the run is closed, or stays open for the recovery."""
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
        For the UTC offset beside every chunk; no sample time depends on it.
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
            "see to the database; the next `abbe` command that connects to the machine takes them over",
        )


async def _opened_or_closed(work: Callable[[], CaptureRecorder]) -> CaptureRecorder:
    """Open a recorder; close it again if the caller is cancelled during that."""
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
    reserve.hold()
    path = segment_path(folder, run_id)
    _active.add(_key(path))  # before a recovery could find the file
    try:
        if path.exists():  # of a deleted database, whose numbers are used again
            set_aside(path, ORPHAN)
        drafter = Drafter(run_id, lambda: clock.utc().timestamp() - clock.monotonic_s())
        log, ingest = _begun(store, Segment(io, path), drafter, reserve, opening, published)
    except BaseException as error:
        _active.discard(_key(path))
        if isinstance(error, OSError):
            raise fault(path, "open", error) from error
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
    """Start both threads of a recording, or neither; then the segment is closed."""
    logs: list[CaptureLog] = []
    with ExitStack() as undo:
        undo.callback(segment.close)
        ingest = Ingest(store, segment.path, lambda: logs[0].disk_full() if logs else None)
        undo.callback(ingest.finish, 0.0)
        logs.append(CaptureLog(segment, drafter, reserve, opening, ingest.add, published))
        undo.pop_all()
    return logs[0], ingest
