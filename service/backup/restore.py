"""`abbe restore`: turn a backup into a database again. Everything is checked first, and a database in use is never replaced."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from abbe.service.audit.book import AuditBook, files_of, sqlite_base, this_account
from abbe.service.backup.backup import CAPTURE, DATABASE, HEADS, KEY, Backup, BackupSource, audit_faults, read_backup, sqlite_file
from abbe.service.backup.pieces import PIECES, join
from abbe.service.capture.settings import segment_folder
from abbe.service.domain.service_records import AuditEvent
from abbe.service.errors import BackupRefused
from abbe.service.storage.copying import is_locked, processes_using, prove_copy, sync_file
from abbe.service.storage.engine import known_revisions
from abbe.service.storage.store import Store

SQLITE_SUFFIXES = ("", "-journal", "-wal", "-shm")
"""Suffixes of a SQLite file and its journals: without its journal an interrupted database is damaged."""


@dataclass(frozen=True, slots=True)
class Restored:
    """Result of a restore. ``aside``: new paths of the previous files."""

    backup: Backup
    database: Path
    records: int
    segments: int
    aside: tuple[Path, ...]


@dataclass(frozen=True, slots=True)
class _Targets:
    """Target paths of a restore."""

    database: Path
    capture: Path
    key: Path
    heads: Path

    def existing(self) -> list[Path]:
        """Target paths that exist."""
        database = [Path(f"{self.database}{ending}") for ending in SQLITE_SUFFIXES]
        return [path for path in (*database, self.capture, self.key, self.heads) if path.exists()]


def restore(
    folder: Path, into: BackupSource, utcnow: Callable[[], datetime], *, replace: bool = False, key_file: Path | None = None
) -> Restored:
    """Restore the backup in ``folder``.

    Everything is checked on a copy beside the target before the target is touched; existing files are renamed, not deleted; the database is
    moved last. An interruption leaves the old database, the new one, or none, but never a partial one.

    Parameters
    ----------
    replace : bool
        Put an existing database aside; otherwise refuse.
    key_file : Path, optional
        Key of the audit, for a backup without it.

    Raises
    ------
    BackupRefused
        The backup is damaged or of a newer version, its audit was changed, or the target database exists or is in use.
    StoreError
        The copied database is damaged.
    """
    database = sqlite_file(into.url, "restore")
    backup = read_backup(folder)
    targets = _check_targets(into, database, replace=replace)
    part = database.parent / f".{database.name}.restoring-{secrets.token_hex(4)}"
    try:
        part.mkdir(mode=0o700)
        shutil.copytree(backup.folder, part, dirs_exist_ok=True, ignore=shutil.ignore_patterns(PIECES))
        if backup.listed.pieces is not None:
            join(backup.folder / PIECES, backup.listed.pieces.names, part / DATABASE)
        if key_file is not None:
            shutil.copyfile(key_file, part / KEY)
        records = _prove(part, folder)
        aside = _put_aside(targets, utcnow()) if replace else ()
        _move_into_place(part, targets)
    except OSError as err:
        raise BackupRefused(f"{database} could not be restored: {err}", "look at disk space and rights") from err
    finally:
        shutil.rmtree(part, ignore_errors=True)
    with Store.open(into.url) as store:
        options = {"from": str(folder), "made_utc": backup.listed.made_utc, "aside": ", ".join(map(str, aside))}
        AuditBook(store, into.url).write(
            AuditEvent(who=this_account(), action="abbe restore", target=str(database), outcome="done", doc=options)
        )
    return Restored(backup, database, records, len(backup.segments), aside)


def _check_targets(into: BackupSource, database: Path, *, replace: bool) -> _Targets:
    """Return the target paths, or refuse if they exist or are in use."""
    if not database.parent.is_dir():
        raise BackupRefused(f"folder {database.parent} does not exist", "create it, or give another --db")
    if users := processes_using(database):
        raise BackupRefused(f"{database} is in use by process {users[0]}", "stop the service first: systemctl stop abbe")
    if database.exists() and is_locked(database):
        raise BackupRefused(f"{database} is in use by another process", "stop the service first: systemctl stop abbe")
    targets = _Targets(database, segment_folder(into.url, into.capture), *files_of(sqlite_base(database)))
    existing = targets.existing()
    if existing and not replace:
        raise BackupRefused(f"{existing[0]} exists", "add --replace to set the existing files aside, or give another --db")
    return targets


def _prove(part: Path, backup: Path) -> int:
    """Check that a copied backup is complete, of a known schema, and unchanged; return its number of audit records."""
    revision = prove_copy(part / DATABASE)
    if revision not in known_revisions():
        raise BackupRefused(
            f"{backup} has schema {revision}, which this version of Abbe does not know", "use the version of Abbe that wrote it"
        )
    key = part / KEY
    records, found = audit_faults(part / DATABASE, part / HEADS, key if key.exists() else None)
    if records and not key.exists():
        raise BackupRefused(f"{backup} has no key of the audit, so its {records} records prove nothing", "give --audit-key FILE")
    if found:
        more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
        raise BackupRefused(f"the audit in {backup} is broken: {found[0]}{more}", "use another backup, or the key that belongs to this one")
    return records


def _put_aside(targets: _Targets, now: datetime) -> tuple[Path, ...]:
    """Rename existing files, the database first; return their new paths."""
    stamp = f".replaced-{now:%Y%m%dT%H%M%S}"
    moved = []
    for path in targets.existing():
        ending = next((one for one in SQLITE_SUFFIXES[1:] if path == Path(f"{targets.database}{one}")), "")
        target = Path(f"{str(path).removesuffix(ending)}{stamp}{ending}")
        if target.exists():
            raise BackupRefused(f"{target} exists", "try again in a second")
        path.rename(target)
        moved.append(target)
    return tuple(moved)


def _move_into_place(part: Path, targets: _Targets) -> None:
    """Move every file to its target, the database last."""
    segments, owner = sorted((part / CAPTURE).glob("run-*")), targets.database.parent.stat()
    if segments:
        targets.capture.mkdir(mode=0o700, parents=True, exist_ok=True)
        _chown_if_root(targets.capture, owner)
    moves = [(path, targets.capture / path.name) for path in segments]
    moves += [(part / HEADS, targets.heads), (part / KEY, targets.key), (part / DATABASE, targets.database)]
    for source, target in moves:
        if source.exists():
            os.chmod(source, 0o600)
            _chown_if_root(source, owner)
            sync_file(source)
            shutil.move(source, target)  # the audit's folder may be on another disk
    for folder in {target.parent for _, target in moves if target.parent.is_dir()}:
        sync_file(folder)


def _chown_if_root(path: Path, owner: os.stat_result) -> None:
    """As root, give a restored file the owner of its folder, so that the service can write it."""
    if os.geteuid() == 0:
        os.chown(path, owner.st_uid, owner.st_gid)
