"""After a crash: what the segments have and the database lacks is taken over, and the run is marked as interrupted.

One segment that cannot be taken over stops neither the others nor the machine: it is set aside under another name, and that is said.
"""

from __future__ import annotations

import fcntl
import os
import threading
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from abbe.service.capture.file_io import RealFileIO
from abbe.service.capture.ingest import BATCH, chunk_of, may_pass
from abbe.service.capture.ledger import DAMAGED, Ledger, ledger_of, settle, streams_doc
from abbe.service.capture.recorder import is_active
from abbe.service.capture.segment import CHUNK, CLOSE, GAP, OPEN, Scan, scan
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
from abbe.service.domain.measured import INTERRUPTED, RUNNING, ChunkRecord, RunRecord
from abbe.service.domain.owner import this_process
from abbe.service.errors import AbbeError, CaptureConflict, CaptureFault, StoreError
from abbe.service.runs.codec import decode_json
from abbe.service.storage.store import Store

# What becomes of a segment whose run is closed: deleted, kept, or renamed because something in it is damaged.


def put_away(path: Path, held: Scan, *, keep: bool) -> None:
    """Delete or keep a segment that was taken over; nothing that could not be read is deleted. Never raises: the next start tries again.

    Parameters
    ----------
    path : Path
        The file.
    held : Scan
        What is in it.
    keep : bool
        Keep it although the database has everything.
    """
    with suppress(OSError):
        if held.damaged or (held.tail_bytes and not _copied(path, held.good_bytes)):
            set_aside(path, DAMAGED_SUFFIX)
        elif not keep:
            path.unlink(missing_ok=True)
        elif held.tail_bytes:
            with path.open("r+b") as file:
                file.truncate(held.good_bytes)
                os.fsync(file.fileno())


def _copied(path: Path, begin: int) -> bool:
    """Copy the end of a file to a file of its own, onto the disk; False when there is no room or the disk reports an error."""
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


# Locks that the operating system gives back when a process ends, however it ends: on a segment, and on the recovery.


LOCK_NAME = "recovery.lock"
WAIT_S = 30.0
_POLL_S = 0.05


@contextmanager
def held_alone(path: Path, wait_s: float = WAIT_S) -> Iterator[bool]:
    """Hold a lock file; False when another process held it all the time.

    Raises
    ------
    CaptureFault
        The file cannot be made.
    """
    try:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o640)
    except OSError as error:
        raise CaptureFault(f"{path}: lock: {error.strerror}", "look at the folder of the segments and its rights") from error
    try:
        until_s = time.monotonic() + wait_s
        while not (got := _got(handle)) and time.monotonic() < until_s:
            threading.Event().wait(_POLL_S)
        yield got
    finally:
        os.close(handle)


@contextmanager
def is_free(path: Path) -> Iterator[bool]:
    """Tell whether no process writes a segment, and keep it so meanwhile. Raises OSError."""
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        yield _got(handle)
    finally:
        os.close(handle)


def _got(handle: int) -> bool:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


__all__ = ["DAMAGED", "RecoveredRun", "ledger_of", "read_segment", "recover_segments"]

MOST_RUNS = 2**31
"""No database has a row of this number; a damaged segment may name it."""


@dataclass(frozen=True, slots=True)
class RecoveredRun:
    """What was done about one segment.

    Parameters
    ----------
    run : int
        Run in the database; 0 where there is none.
    name : str
        ``campaign/label``; empty when the database has no such run.
    new_chunks : int
        Chunks that the database lacked.
    cut_bytes : int
        Torn tail that was cut off; a copy of it is kept.
    text : str
        One sentence for people.
    """

    run: int
    name: str
    new_chunks: int
    cut_bytes: int
    text: str


def recover_segments(store: Store, settings: CaptureSettings) -> list[RecoveredRun]:
    """Take over what a killed process, a power cut or a locked database left in segments. Blocks; call it before anything is measured.

    Raises
    ------
    StoreError
        The database does not take it now. What was done so far stays done; it can be called again.
    CaptureFault
        The folder of the segments cannot be used.
    """
    folder = folder_of(store, settings)
    found = _in_folder(store, folder, settings, only_ours=False)
    for other in other_folders(store.url, settings, folder):
        found += _in_folder(store, other, settings, only_ours=True)
    return found


class _Runs:
    """Runs by their numbers, each read when it is asked for: with their documents all of a month's runs are 100 MB."""

    def __init__(self, store: Store) -> None:
        self._store, self._found = store, dict[int, RunRecord | None]()

    def get(self, number: int) -> RunRecord | None:
        """The run, None if there is none."""
        if number not in self._found:
            self._found[number] = self._store.runs.numbered(number) if 0 < number < MOST_RUNS else None
        return self._found[number]


def _in_folder(store: Store, folder: Path, settings: CaptureSettings, *, only_ours: bool) -> list[RecoveredRun]:
    """Take over what lies in one folder; in one that may be another database's, only what names a run of this one."""
    if not folder.is_dir() or not any(folder.glob(f"*{SUFFIX}")):
        return []
    known = _Runs(store)
    if only_ours and not any(_is_ours(path, known) for path in folder.glob(f"*{SUFFIX}")):
        return []
    with held_alone(folder / LOCK_NAME) as alone:
        if not alone:
            return [RecoveredRun(0, "", 0, 0, f"another process is taking over what is in {folder}; it was left to it")]
        paths = [path for path in sorted(folder.glob(f"*{SUFFIX}")) if not only_ours or _is_ours(path, known)]
        known = _Runs(store)  # anew: another process may have closed some meanwhile
        found = (_recover_one(store, path, known, settings) for path in paths)
        return [one for one in found if one is not None]


def _is_ours(path: Path, known: _Runs) -> bool:
    """Whether a segment says that it is of a run of this database: same number, name and instant of its beginning."""
    try:
        records = read_segment(path).records
        about = decode_json(records[0].payload)[0] if records and records[0].kind == OPEN else {}
        run = known.get(int(about.get("run", 0)))
    except (CaptureFault, ValueError, KeyError, TypeError, StoreError):
        return False
    return run is not None and (about.get("label"), about.get("started_utc")) == (run.label, run.started_utc)


def read_segment(path: Path) -> Scan:
    """Scan a file.

    Raises
    ------
    CaptureFault
        It cannot be read, or a newer version of this program wrote it.
    """
    try:
        return _read(path)
    except OSError as error:
        raise CaptureFault(f"{path}: cannot be read: {error.strerror}", "look at the disk") from error


def _read(path: Path) -> Scan:
    return scan(path.read_bytes())  # not mapped: a file that is cut meanwhile, or a bad sector, would kill the process


def _recover_one(store: Store, path: Path, known: _Runs, settings: CaptureSettings) -> RecoveredRun | None:
    number = path.stem.rpartition("-")[2]
    if not number.isdecimal() or path.name != segment_path(path.parent, int(number)).name:
        return _aside(path, CONFLICT, None, "it has the name of no segment")
    run = known.get(int(number))
    if is_active(path) or (run is not None and run.status == RUNNING and not _abandoned(run)):
        return None
    try:
        with is_free(path) as free:
            if not free:
                return _told(run, f"{path.name} is still open in a process that records; it was left to it")
            return _take_over(store, path, run, settings)
    except CaptureFault as error:  # of a newer version: that one can take it over
        return _told(run, f"{path.name} was left as it is: {error}")
    except (CaptureConflict, ValueError, KeyError, TypeError, OSError) as error:
        return _give_up(store, path, run, error)
    except StoreError as error:
        if may_pass(error):
            raise
        return _give_up(store, path, run, error)


def _take_over(store: Store, path: Path, run: RunRecord | None, settings: CaptureSettings) -> RecoveredRun | None:
    held = _read(path)
    if run is None or not _belongs(held, run):
        return _aside(path, ORPHAN, None, "it belongs to no run of this database")
    if run.status != RUNNING:
        return _of_closed(store, path, run, held, settings)
    added = _ingest(store, run.id, held)
    ledger = settle(store, run.id, held)
    text = _ending(held, added)
    capture = ledger.doc() | {"records": len(held.records), "head_sha256": held.head.hex(), "cut_bytes": held.tail_bytes}
    capture["streams"] = streams_doc(held.records)
    if not _closed(store, run, text, ledger, capture):
        return None
    put_away(path, held, keep=settings.keep)
    return RecoveredRun(run.id, _name(run), added, held.tail_bytes, f"run {_name(run)}: {text}")


def _of_closed(store: Store, path: Path, run: RunRecord, held: Scan, settings: CaptureSettings) -> RecoveredRun | None:
    """A run that was closed before the process could delete the file, or that another process closed without it."""
    if settings.keep:
        return None
    keys = store.chunks.crcs(run.id)
    chunks = [record for record in held.records if record.kind in (CHUNK, GAP)]
    lacking = sum(keys.get((one.channel, one.chunk_no)) != zlib.crc32(one.payload) for one in chunks)
    if lacking:
        return _aside(path, ORPHAN, run, f"the run is closed, but {lacking} of its {len(chunks)} chunks are not in the database")
    if held.damaged:
        return _aside(path, ORPHAN, run, f"the run is closed, and the segment is damaged in {len(held.damaged)} places")
    put_away(path, held, keep=False)
    return None


def _closed(store: Store, run: RunRecord, text: str, ledger: Ledger | None, capture: dict[str, Any]) -> bool:
    """Close a run; False when another process did it at the same time."""
    gaps = [gap.doc() for gap in ledger.gaps] if ledger is not None else []
    try:
        store.runs.finish(run.id, INTERRUPTED, text, {"gaps": gaps, "capture": capture} if ledger is not None else None)
    except StoreError:
        if store.runs.find(run.id).status == RUNNING:
            raise
        return False
    return True


def _give_up(store: Store, path: Path, run: RunRecord | None, error: Exception) -> RecoveredRun | None:
    """Nothing is overwritten and nothing deleted; the run is closed with the reason, so that the machine can be used."""
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
        where = f"it was set aside as {set_aside(path, suffix).name}"
    except OSError as error:
        where = f"it could not be renamed ({error.strerror})"
    about = f"run {_name(run)}: " if run is not None else ""
    return _told(run, f"{about}{path.name} was not taken over: {why}; {where}")


def _told(run: RunRecord | None, text: str) -> RecoveredRun:
    return RecoveredRun(0 if run is None else run.id, "" if run is None else _name(run), 0, 0, text)


def _name(run: RunRecord) -> str:
    return f"{run.campaign}/{run.label}"


def _abandoned(run: RunRecord) -> bool:
    # a run of this very process that is no longer recorded into was left by a database that did not take its end
    return run.owner.is_gone() or run.owner == this_process()


def _belongs(held: Scan, run: RunRecord) -> bool:
    """A database that was made anew, or another one, has the same numbers for other runs, but none begun at the same microsecond."""
    if not held.records or held.records[0].kind != OPEN:
        return True
    about = decode_json(held.records[0].payload)[0]
    return bool(about.get("label", run.label) == run.label and about.get("started_utc", run.started_utc) == run.started_utc)


def _ingest(store: Store, run_id: int, held: Scan) -> int:
    keys = store.chunks.crcs(run_id)
    missing: list[ChunkRecord] = []
    for record in held.records:
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


def _ending(held: Scan, added: int) -> str:
    closing = [record for record in held.records if record.kind == CLOSE]
    why = "the process ended before the run was closed"
    if closing:
        said = decode_json(closing[0].payload)[0]
        why = f"recorded to its end ({said['status']}), but the process ended before the database knew"
    parts = [f"interrupted: {why}"]
    if added:
        parts.append(f"{added} chunks were taken over from the segment")
    if held.damaged:
        parts.append(f"the segment is damaged in {len(held.damaged)} places and kept beside the others as *{DAMAGED_SUFFIX}")
    if held.broken_links:
        parts.append("records of the segment were exchanged or taken out")
    return "; ".join(parts)
