"""Copy a SQLite database while others write it, check the copy, and find the processes that have a database open."""

from __future__ import annotations

import os
import sqlite3
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

from abbe.service.errors import StoreError

PAGES = 1024
"""Pages copied per step; between two steps other processes may write."""
RESTARTS = 5
"""SQLite restarts a copy after each write. After this many restarts the copy is made in one step, while writers wait."""
LOCKED_S = 60.0
"""How long a copy waits for a process that holds the database, s."""
FAULTS_SHOWN = 3


class _RestartedTooOftenError(Exception):
    """The source was written between two steps too often."""


class _LockedError(Exception):
    """No page could be copied for too long."""


def copy_online(source: Path, target: Path, locked_s: float = LOCKED_S) -> None:
    """Copy a SQLite database, as it is at one instant, into a new file with rights 0600. Writers may continue.

    On return ``target`` is on the disk; after an error a part of it may be there. ``locked_s``: how long to wait for a process that holds
    the database, s.

    Raises
    ------
    StoreError
        The database stays locked, the file is not a database, or the disk is full.
    """
    os.close(os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600))
    try:
        with closing(_reader(source)) as origin, closing(sqlite3.connect(target)) as copy:
            try:
                origin.backup(copy, pages=PAGES, progress=_stall_detection(locked_s, RESTARTS), sleep=0.05)
            except _RestartedTooOftenError:
                origin.backup(copy, pages=-1, progress=_stall_detection(locked_s, None), sleep=0.05)
            copy.execute("PRAGMA journal_mode=DELETE")  # one file: a copy in WAL mode would need two more
    except _LockedError:
        raise StoreError(f"database {source}: locked for {locked_s:g} s", "another process is writing: stop it or try again") from None
    except sqlite3.Error as err:
        raise StoreError(f"database {source} cannot be copied to {target}: {err}", "look at disk space and rights") from err
    sync_file(target)


def _stall_detection(locked_s: float, restarts: int | None) -> Callable[[int, int, int], None]:
    """Return a callback for each step of SQLite's backup. It ends a copy that stalls or restarts over ``restarts`` times (None: any)."""
    last_left, restarted, moved_s = -1, 0, time.monotonic()

    def after_step(_status: int, left: int, _total: int) -> None:
        nonlocal last_left, restarted, moved_s
        now_s = time.monotonic()
        if left == last_left:
            if now_s - moved_s > locked_s:
                raise _LockedError
            return
        restarted += left > last_left >= 0
        last_left, moved_s = left, now_s
        if restarts is not None and restarted > restarts:
            raise _RestartedTooOftenError

    return after_step


def _reader(path: Path) -> sqlite3.Connection:
    if not path.is_file():
        raise StoreError(f"there is no database {path}", "give the file that `abbe` made")
    # mode=rw, not ro: the journal of a killed process has to be rolled back before anything is read.
    return sqlite3.connect(f"{path.resolve().as_uri()}?mode=rw", uri=True, timeout=0.1)


def prove_copy(path: Path) -> str:
    """Check that a copied database is undamaged and complete; return its schema revision. The file is only read.

    Raises
    ------
    StoreError
        SQLite finds damage, rows refer to missing rows, or Abbe did not make the database.
    """
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as copy:
            found = [str(row[0]) for row in copy.execute("PRAGMA integrity_check")]
            if found != ["ok"]:
                raise StoreError(f"{path} is damaged: {'; '.join(found[:FAULTS_SHOWN])}", "use another backup")
            if orphans := copy.execute("PRAGMA foreign_key_check").fetchall():
                raise StoreError(
                    f"{path}: {len(orphans)} rows refer to missing rows (the first one in table {orphans[0][0]})", "use another backup"
                )
            row = copy.execute("SELECT version_num FROM alembic_version").fetchone()
    except sqlite3.Error as err:
        raise StoreError(f"{path} is not a database of Abbe: {err}", "use another backup") from err
    if row is None:
        raise StoreError(f"{path} has no schema: it was never used", "use another backup")
    return str(row[0])


def rows_of(path: Path, query: str) -> list[tuple[Any, ...]]:
    """Rows of a copied database that no process writes.

    Raises
    ------
    StoreError
        The file cannot be read.
    """
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as copy:
            return [tuple(row) for row in copy.execute(query)]
    except sqlite3.Error as err:
        raise StoreError(f"{path}: {err}", "use another backup") from err


def processes_using(path: Path) -> list[int]:
    """Other processes of this computer that have a file open. Needs /proc; only root sees processes of other accounts."""
    try:
        wanted = path.stat()
    except FileNotFoundError:
        return []
    found = set()
    for link in Path("/proc").glob("[0-9]*/fd/*"):
        try:
            one = link.stat()
        except OSError:  # the process has ended or belongs to another account
            continue
        if (one.st_dev, one.st_ino) == (wanted.st_dev, wanted.st_ino):
            found.add(int(link.parts[2]))
    return sorted(found - {os.getpid()})


def is_locked(path: Path) -> bool:
    """Whether a process is reading or writing a SQLite database."""
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=rw", uri=True, timeout=0.0)) as probe:
            probe.isolation_level = None
            probe.execute("BEGIN EXCLUSIVE")
            probe.execute("ROLLBACK")
    except sqlite3.OperationalError as err:
        return "locked" in str(err)
    except sqlite3.DatabaseError:  # a damaged database may be replaced
        return False
    return False


def sync_file(path: Path) -> None:
    """Flush a file, or a folder's entries, to the disk. Raises OSError."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
