"""Recovery after a crash: moves missing records from segments to the database, and marks their runs as interrupted.

A segment that cannot be recovered blocks neither the others nor the machine: it is renamed and reported in a message.
"""

from __future__ import annotations

import os
import threading
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from abbe.service.capture.ingest import BATCH, chunk_of, may_pass
from abbe.service.capture.ledger import DAMAGED, Ledger, ledger_of, settle, streams_doc
from abbe.service.capture.recorder import is_active
from abbe.service.capture.segment import CHUNK, CLOSE, GAP, OPEN, RealFileIO, Scan, scan
from abbe.service.capture.settings import (
    CONFLICT,
    DAMAGED_SUFFIX,
    ORPHAN,
    SUFFIX,
    TAIL,
    CaptureSettings,
    folder_of,
    free_name,
    other_folders,
    segment_path,
    set_aside,
)
from abbe.service.domain.measured import INTERRUPTED, RUNNING, ChunkRecord, RunRecord, this_process
from abbe.service.errors import AbbeError, CaptureConflict, CaptureFault, StoreError
from abbe.service.files import lock_at_once
from abbe.service.runs.chunks import decode_json
from abbe.service.storage.store import Store


def put_away(path: Path, scanned: Scan, *, keep: bool) -> None:
    """Delete a recovered segment unless ``keep``; unreadable parts always stay on the disk. Never raises: the next start tries again."""
    with suppress(OSError):
        if scanned.damaged or (scanned.tail_bytes and not _copied(path, scanned.good_bytes)):
            set_aside(path, DAMAGED_SUFFIX)
        elif not keep:
            path.unlink(missing_ok=True)
        elif scanned.tail_bytes:
            with path.open("r+b") as file:
                file.truncate(scanned.good_bytes)
                os.fsync(file.fileno())


def _copied(path: Path, begin: int) -> bool:
    """Copy the end of a file durably to a file of its own; False if there is no room or the disk reports an error."""
    copy = free_name(path, TAIL)
    try:
        with path.open("rb") as file, copy.open("xb") as other:
            file.seek(begin)
            other.write(file.read())
            other.flush()
            os.fsync(other.fileno())
        RealFileIO().sync_folder(path.parent)
    except OSError:
        with suppress(OSError):
            copy.unlink(missing_ok=True)
        return False
    return True


# The operating system releases the locks on segments and on the recovery at any end of a process.
LOCK_NAME = "recovery.lock"
WAIT_S = 30.0
_POLL_S = 0.05


@contextmanager
def exclusive_lock(path: Path, wait_s: float = WAIT_S) -> Iterator[bool]:
    """Lock a file for the block; yields False if another process kept the lock for ``wait_s``.

    Raises
    ------
    CaptureFault
        The file cannot be created.
    """
    try:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o640)
    except OSError as error:
        raise CaptureFault(f"{path}: cannot be locked: {error.strerror}", "check the folder of the segments and its permissions") from error
    try:
        until_s = time.monotonic() + wait_s
        while not (locked := _try_lock(handle)) and time.monotonic() < until_s:
            threading.Event().wait(_POLL_S)
        yield locked
    finally:
        os.close(handle)


@contextmanager
def is_free(path: Path) -> Iterator[bool]:
    """Lock a segment for the block; yields False if a process writes it. Raises OSError."""
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        yield _try_lock(handle)
    finally:
        os.close(handle)


def _try_lock(handle: int) -> bool:
    try:
        lock_at_once(handle)
    except BlockingIOError:
        return False
    return True


__all__ = ["DAMAGED", "RecoveredRun", "ledger_of", "read_segment", "recover_segments"]

MOST_RUNS = 2**31
"""Upper limit of run numbers; only a damaged segment names a larger one."""


@dataclass(frozen=True, slots=True)
class RecoveredRun:
    """Result of the recovery of one segment.

    ``run``: number in the database, 0 without a run; ``name``: ``campaign/label``, empty without a run; ``new_chunks``: added to the
    database; ``cut_bytes``: length of the torn tail, of which a copy is kept; ``text``: one sentence for people.
    """

    run: int
    name: str
    new_chunks: int
    cut_bytes: int
    text: str


def recover_segments(store: Store, settings: CaptureSettings) -> list[RecoveredRun]:
    """Recover the segments left by a killed process, a power cut or a locked database. Blocks; call it before any measurement.

    Raises
    ------
    StoreError
        The database refuses records now. Finished segments stay recovered; call it again later.
    CaptureFault
        The folder of the segments cannot be used.
    """
    folder = folder_of(store, settings)
    found = _in_folder(store, folder, settings, only_ours=False)
    for other in other_folders(store.url, settings, folder):
        found += _in_folder(store, other, settings, only_ours=True)
    return found


class _KnownRuns:
    """Runs by number, each loaded on demand: a month's runs with their documents take 100 MB."""

    def __init__(self, store: Store) -> None:
        self._store, self._found = store, dict[int, RunRecord | None]()

    def get(self, number: int) -> RunRecord | None:
        """Return the run, or None."""
        if number not in self._found:
            self._found[number] = self._store.runs.numbered(number) if 0 < number < MOST_RUNS else None
        return self._found[number]


def _in_folder(store: Store, folder: Path, settings: CaptureSettings, *, only_ours: bool) -> list[RecoveredRun]:
    """Recover the segments of one folder; ``only_ours``: only those of runs of this database."""
    if not folder.is_dir() or not any(folder.glob(f"*{SUFFIX}")):
        return []
    known = _KnownRuns(store)
    if only_ours and not any(_is_ours(path, known) for path in folder.glob(f"*{SUFFIX}")):
        return []
    with exclusive_lock(folder / LOCK_NAME) as locked:
        if not locked:
            return [RecoveredRun(0, "", 0, 0, f"another process is recovering {folder}; nothing was done here")]
        paths = [path for path in sorted(folder.glob(f"*{SUFFIX}")) if not only_ours or _is_ours(path, known)]
        known = _KnownRuns(store)  # reload: another process may have closed some
        found = (_recover_one(store, path, known, settings) for path in paths)
        return [one for one in found if one is not None]


def _is_ours(path: Path, known: _KnownRuns) -> bool:
    """Whether a segment belongs to a run of this database, by number, name and start time."""
    try:
        records = read_segment(path).records
        about = decode_json(records[0].payload)[0] if records and records[0].kind == OPEN else {}
        run = known.get(int(about.get("run", 0)))
    except (CaptureFault, ValueError, KeyError, TypeError, StoreError):
        return False
    return run is not None and (about.get("label"), about.get("started_utc")) == (run.label, run.started_utc)


def read_segment(path: Path) -> Scan:
    """Scan a segment file. Raises CaptureFault if it is unreadable or of a newer version of this program."""
    try:
        return _read(path)
    except OSError as error:
        raise CaptureFault(f"{path}: cannot be read: {error.strerror}", "look at the disk") from error


def _read(path: Path) -> Scan:
    return scan(path.read_bytes())  # not mapped: a truncation of the file, or a bad sector, would kill the process


def _recover_one(store: Store, path: Path, known: _KnownRuns, settings: CaptureSettings) -> RecoveredRun | None:
    number = path.stem.rpartition("-")[2]
    if not number.isdecimal() or path.name != segment_path(path.parent, int(number)).name:
        return _aside(path, CONFLICT, None, "its name is not that of a segment")
    run = known.get(int(number))
    if is_active(path) or (run is not None and run.status == RUNNING and not _abandoned(run)):
        return None
    try:
        with is_free(path) as free:
            if not free:
                return _report(run, f"a recording process still writes {path.name}; nothing was done")
            return _take_over(store, path, run, settings)
    except CaptureFault as error:  # the segment is of a newer version, which can recover it
        return _report(run, f"{path.name} was left as it is: {error}")
    except (CaptureConflict, ValueError, KeyError, TypeError, OSError) as error:
        return _give_up(store, path, run, error)
    except StoreError as error:
        if may_pass(error):
            raise
        return _give_up(store, path, run, error)


def _take_over(store: Store, path: Path, run: RunRecord | None, settings: CaptureSettings) -> RecoveredRun | None:
    scanned = _read(path)
    if run is None or not _belongs(scanned, run):
        return _aside(path, ORPHAN, None, "it belongs to no run of this database")
    if run.status != RUNNING:
        return _of_closed(store, path, run, scanned, settings)
    added = _ingest(store, run.id, scanned)
    ledger = settle(store, run.id, scanned)
    text = _ending(scanned, added)
    capture = ledger.doc() | {"records": len(scanned.records), "head_sha256": scanned.head.hex(), "cut_bytes": scanned.tail_bytes}
    capture["streams"] = streams_doc(scanned.records)
    if not _closed(store, run, text, ledger, capture):
        return None
    put_away(path, scanned, keep=settings.keep)
    return RecoveredRun(run.id, _name(run), added, scanned.tail_bytes, f"run {_name(run)}: {text}")


def _of_closed(store: Store, path: Path, run: RunRecord, scanned: Scan, settings: CaptureSettings) -> RecoveredRun | None:
    """Handle the segment of a closed run: its process ended before deleting it, or another process closed the run without its file."""
    if settings.keep:
        return None
    keys = store.chunks.crcs(run.id)
    chunks = [record for record in scanned.records if record.kind in (CHUNK, GAP)]
    lacking = sum(keys.get((one.channel, one.chunk_no)) != zlib.crc32(one.payload) for one in chunks)
    if lacking:
        return _aside(path, ORPHAN, run, f"the run is closed, but {lacking} of its {len(chunks)} chunks are not in the database")
    if scanned.damaged:
        return _aside(path, ORPHAN, run, f"the run is closed, and the segment is damaged in {len(scanned.damaged)} places")
    put_away(path, scanned, keep=False)
    return None


def _closed(store: Store, run: RunRecord, text: str, ledger: Ledger | None, capture: dict[str, Any]) -> bool:
    """Close a run; False if another process did so at the same time."""
    gaps = [gap.doc() for gap in ledger.gaps] if ledger is not None else []
    try:
        store.runs.finish(run.id, INTERRUPTED, text, {"gaps": gaps, "capture": capture} if ledger is not None else None)
    except StoreError:
        if store.runs.find(run.id).status == RUNNING:
            raise
        return False
    return True


def _give_up(store: Store, path: Path, run: RunRecord | None, error: Exception) -> RecoveredRun | None:
    """Set a segment aside, deleting nothing, and close its run with the reason, so that the machine stays usable."""
    why = f"{error.code}: {error}" if isinstance(error, AbbeError) else repr(error)
    done = _aside(path, CONFLICT, run, why)
    if run is not None and run.status == RUNNING:
        ledger: Ledger | None = None
        with suppress(ValueError, KeyError, TypeError, StoreError):
            ledger = ledger_of(store.chunks.of_run(run.id))
        _closed(store, run, f"interrupted: {done.text}", ledger, {} if ledger is None else ledger.doc())
    return done


def _aside(path: Path, suffix: str, run: RunRecord | None, why: str) -> RecoveredRun:
    try:
        outcome = f"it was set aside as {set_aside(path, suffix).name}"
    except OSError as error:
        outcome = f"it could not be renamed ({error.strerror})"
    about = f"run {_name(run)}: " if run is not None else ""
    return _report(run, f"{about}{path.name} was not taken over: {why}; {outcome}")


def _report(run: RunRecord | None, text: str) -> RecoveredRun:
    return RecoveredRun(0 if run is None else run.id, "" if run is None else _name(run), 0, 0, text)


def _name(run: RunRecord) -> str:
    return f"{run.campaign}/{run.label}"


def _abandoned(run: RunRecord) -> bool:
    # an inactive open run of this process: the database did not take its end
    return run.owner.is_gone() or run.owner == this_process()


def _belongs(scanned: Scan, run: RunRecord) -> bool:
    """Whether label and start time match: another database uses the same run numbers, but not the same start microsecond."""
    if not scanned.records or scanned.records[0].kind != OPEN:
        return True
    about = decode_json(scanned.records[0].payload)[0]
    return bool(about.get("label", run.label) == run.label and about.get("started_utc", run.started_utc) == run.started_utc)


def _ingest(store: Store, run_id: int, scanned: Scan) -> int:
    keys = store.chunks.crcs(run_id)
    missing: list[ChunkRecord] = []
    for record in scanned.records:
        if record.kind not in (CHUNK, GAP):
            continue
        known = keys.get((record.channel, record.chunk_no))
        if known is None:
            missing.append(chunk_of(record))
        elif known != zlib.crc32(record.payload):
            raise CaptureConflict(
                f"run {run_id}: chunk {record.chunk_no} of channel {record.channel!r} is in the database with other content",
                "nothing was overwritten: compare the segment with the database",
            )
    return sum(store.chunks.ingest(missing[at : at + BATCH]) for at in range(0, len(missing), BATCH))


def _ending(scanned: Scan, added: int) -> str:
    closing = [record for record in scanned.records if record.kind == CLOSE]
    why = "the process ended before the run was closed"
    if closing:
        end = decode_json(closing[0].payload)[0]
        why = f"recorded to its end ({end['status']}), but the process ended before the database was updated"
    parts = [f"interrupted: {why}"]
    if added:
        parts.append(f"{added} chunks were taken over from the segment")
    if scanned.damaged:
        parts.append(f"the segment is damaged in {len(scanned.damaged)} places and kept beside the others as *{DAMAGED_SUFFIX}")
    if scanned.broken_links:
        parts.append("records of the segment were exchanged or removed")
    return "; ".join(parts)
