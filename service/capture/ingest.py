"""Moves records from a segment to the database in a thread of its own: a locked or missing database delays nothing else."""

from __future__ import annotations

import os
import threading
import zlib
from collections import deque
from collections.abc import Callable
from pathlib import Path

from sqlalchemy.exc import DataError, DBAPIError, IntegrityError, ProgrammingError, TimeoutError

from abbe.service.capture.segment import CHUNK, GAP, Record, decode_at
from abbe.service.domain.measured import ChunkRecord
from abbe.service.errors import AbbeError, CaptureFault, StoreError
from abbe.service.storage.store import Store

RETRY_S = 0.1
END_S = 10.0
"""Longest wait at the end for a pending write of the database."""
BATCH = 200
TOGETHER_S = 0.25
"""Longest time that a record waits for others to share its transaction. The segment keeps it safe meanwhile; one transaction per record
(100 per second) would cost more than the rest of the capture."""
TOGETHER_BYTES = 1 << 16
"""Queued records of this total size wait no longer: on a full disk the database must get all of them, and the reserve is small."""


def chunk_of(record: Record) -> ChunkRecord:
    """Convert a record of a segment to a row of the database."""
    r = record
    crc = zlib.crc32(r.payload)
    count = r.count if r.kind == CHUNK else 1
    return ChunkRecord(r.run, r.channel, r.chunk_no, count, r.codec, crc, r.payload, r.first_host_s, r.last_host_s, r.first_us, r.last_us)


def may_pass(error: BaseException) -> bool:
    """Whether the database may take the same chunks later: it is locked, full, restarting or temporarily gone."""
    cause = error.__cause__
    return isinstance(cause, DBAPIError | TimeoutError) and not isinstance(cause, IntegrityError | DataError | ProgrammingError)


def is_full(error: BaseException) -> bool:
    """Whether the database reports a full disk, by SQLite's message or PostgreSQL's code (53100, disk_full)."""
    original = getattr(error.__cause__, "orig", None)
    if not isinstance(error, StoreError) or original is None:
        return False
    return getattr(original, "sqlstate", None) == "53100" or any(text in str(original).lower() for text in ("is full", "no space left"))


class Ingest:
    """Reads records back from the segment at ``path``, checks them, and retries until the database has taken them.

    Calls ``disk_full`` when the database has no disk space.
    """

    def __init__(self, store: Store, path: Path, disk_full: Callable[[], None]) -> None:
        self.error: AbbeError | None = None
        self.ingested = 0
        self._store, self._disk_full = store, disk_full
        self._file = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        self._places: deque[tuple[int, int]] = deque()
        self._bytes = 0
        self._hurry = self._stop = False
        self._news = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="abbe-ingest", daemon=True)
        self._thread.start()

    def add(self, places: list[tuple[int, int]]) -> None:
        """Queue durable records by offset and length in the segment."""
        with self._news:
            idle = not self._places
            self._places.extend(places)
            self._bytes += sum(length for _, length in places)
            if idle or self._enough():
                self._news.notify_all()

    @property
    def waiting(self) -> int:
        """Number of records that the database does not have yet."""
        return len(self._places)

    def finish(self, timeout_s: float) -> bool:
        """Wait until the database has everything; False if it did not take everything in time. The segment still has it."""
        with self._news:
            self._hurry = True
            self._news.notify_all()
            done = self._news.wait_for(lambda: not self._places or self.error is not None, timeout_s)
            self._stop = True
            self._news.notify_all()
        self._thread.join(END_S)
        if self._thread.is_alive():  # the thread still uses the file: keep it open
            return False
        os.close(self._file)
        return done and self.error is None

    def _run(self) -> None:
        again = False
        while True:
            with self._news:
                self._news.wait_for(lambda: self._places or self._stop)
                if not again:
                    self._news.wait_for(lambda: self._hurry or self._stop or self._enough(), TOGETHER_S)
                batch = [self._places[k] for k in range(min(BATCH, len(self._places)))]
                if self._stop or not batch:
                    return
            try:
                self._give([self._read(*place) for place in batch])
            except AbbeError as error:
                if not may_pass(error):
                    self._fail(error)
                    return
                with self._news:
                    self._news.wait_for(lambda: self._stop, RETRY_S)
                if is_full(error):
                    self._disk_full()
                again = True
                continue
            except Exception as error:  # noqa: BLE001 - a silent end of the thread would look like a slow database
                self._fail(CaptureFault(f"the transfer to the database failed: {error!r}", "report this as a defect of Abbe"))
                return
            with self._news:
                for _ in batch:
                    self._bytes -= self._places.popleft()[1]
                self.ingested += len(batch)
                again = False
                self._news.notify_all()

    def _enough(self) -> bool:
        return len(self._places) >= BATCH or self._bytes >= TOGETHER_BYTES

    def _fail(self, error: AbbeError) -> None:
        with self._news:
            self.error = error
            self._news.notify_all()

    def _give(self, records: list[Record]) -> None:
        chunks = [chunk_of(record) for record in records if record.kind in (CHUNK, GAP)]
        if chunks:
            self._store.chunks.ingest(chunks)

    def _read(self, offset: int, length: int) -> Record:
        try:
            found = decode_at(os.pread(self._file, length, offset), 0)
        except OSError as error:
            raise CaptureFault(f"the segment cannot be read back: {error.strerror}", "check the disk") from error
        if found is None:
            raise CaptureFault("the segment does not read back as it was written", "look at the disk")
        return found[0]
