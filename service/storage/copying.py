"""Copies of a SQLite database while others write it, checked to be whole; and which processes have a database open."""

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
"""Copied at a time; between two steps others may write."""
RESTARTS = 5
"""A database that is written all the time makes SQLite begin again and again; then it is copied in one step, and writers wait."""
LOCKED_S = 60.0
"""How long a copy waits for a process that holds the database, s."""
FAULTS_SHOWN = 3


class _BegunAgainError(Exception):
    """The source was written between two steps too often."""


class _LockedError(Exception):
    """Nothing could be copied for too long."""


def copy_online(source: Path, target: Path, locked_s: float = LOCKED_S) -> None:
    """Copy a SQLite database as it is at one instant, by SQLite's online backup, into a file of rights 0600. Writers may go on.

    Parameters
    ----------
    source : Path
        The database.
    target : Path
        A file that does not exist. On return it is on the disk; after an error it may be there in part.
    locked_s : float
        How long to wait for a process that holds the database, s.

    Raises
    ------
    StoreError
        It is locked all the time, no database, or the disk is full.
    """
    os.close(os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600))
    try:
        with closing(_reader(source)) as origin, closing(sqlite3.connect(target)) as copy:
            try:
                origin.backup(copy, pages=PAGES, progress=_watch(locked_s, RESTARTS), sleep=0.05)
            except _BegunAgainError:
                origin.backup(copy, pages=-1, progress=_watch(locked_s, None), sleep=0.05)
            copy.execute("PRAGMA journal_mode=DELETE")  # one file: a copy in WAL mode would want two more beside it
    except _LockedError:
        raise StoreError(f"database {source}: locked for {locked_s:g} s", "another process is writing: stop it or try again") from None
    except sqlite3.Error as err:
        raise StoreError(f"database {source} cannot be copied to {target}: {err}", "look at disk space and rights") from err
    sync_file(target)


def _watch(locked_s: float, restarts: int | None) -> Callable[[int, int, int], None]:
    """SQLite calls this after each step: it ends a copy that makes no progress."""
    seen = {"left": -1, "restarts": 0}
    moved_s = [time.monotonic()]

    def after_step(_status: int, left: int, _total: int) -> None:
        now_s = time.monotonic()
        if left == seen["left"]:
            if now_s - moved_s[0] > locked_s:
                raise _LockedError
            return
        seen["restarts"] += left > seen["left"] >= 0
        seen["left"], moved_s[0] = left, now_s
        if restarts is not None and seen["restarts"] > restarts:
            raise _BegunAgainError

    return after_step


def _reader(path: Path) -> sqlite3.Connection:
    if not path.is_file():
        raise StoreError(f"there is no database {path}", "give the file that `abbe` made")
    # mode=rw and not ro: a journal that a killed process left has to be rolled back before anything is read.
    return sqlite3.connect(f"{path.resolve().as_uri()}?mode=rw", uri=True, timeout=0.1)


def prove_copy(path: Path) -> str:
    """Prove that a copied database is whole; return its schema revision. The file is only read.

    Raises
    ------
    StoreError
        SQLite finds it damaged, rows refer to rows that are not there, or Abbe did not make it.
    """
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as copy:
            found = [str(row[0]) for row in copy.execute("PRAGMA integrity_check")]
            if found != ["ok"]:
                raise StoreError(f"{path} is damaged: {'; '.join(found[:FAULTS_SHOWN])}", "take another backup")
            if strays := copy.execute("PRAGMA foreign_key_check").fetchall():
                raise StoreError(
                    f"{path}: {len(strays)} rows refer to rows that are not there (first: {strays[0][0]})", "take another backup"
                )
            row = copy.execute("SELECT version_num FROM alembic_version").fetchone()
    except sqlite3.Error as err:
        raise StoreError(f"{path} is no database of Abbe: {err}", "take another backup") from err
    if row is None:
        raise StoreError(f"{path} has no schema: it was never used", "take another backup")
    return str(row[0])


def rows_of(path: Path, query: str) -> list[tuple[Any, ...]]:
    """Rows of a copied database that no process writes.

    Raises
    ------
    StoreError
        It cannot be read.
    """
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as copy:
            return [tuple(row) for row in copy.execute(query)]
    except sqlite3.Error as err:
        raise StoreError(f"{path}: {err}", "take another backup") from err


def users_of(path: Path) -> list[int]:
    """Processes of this computer, this one left out, that have a file open. Needs /proc; another account's processes only root sees."""
    try:
        wanted = path.stat()
    except FileNotFoundError:
        return []
    found = set()
    for link in Path("/proc").glob("[0-9]*/fd/*"):
        try:
            one = link.stat()
        except OSError:  # it ended meanwhile, or belongs to another account
            continue
        if (one.st_dev, one.st_ino) == (wanted.st_dev, wanted.st_ino):
            found.add(int(link.parts[2]))
    return sorted(found - {os.getpid()})


def is_locked(path: Path) -> bool:
    """Whether a process is in the middle of reading or writing a SQLite database."""
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=rw", uri=True, timeout=0.0)) as probe:
            probe.isolation_level = None
            probe.execute("BEGIN EXCLUSIVE")
            probe.execute("ROLLBACK")
    except sqlite3.OperationalError as err:
        return "locked" in str(err)
    except sqlite3.DatabaseError:  # damaged: that is why it is restored
        return False
    return False


def sync_file(path: Path) -> None:
    """Return only when a file, or a folder's entries, are on the disk. Raises OSError."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
