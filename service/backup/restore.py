"""`abbe restore`: a backup becomes a database again, after everything in it was proved, and never over one that is in use."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from abbe.service.audit.book import AuditBook, files_of, sqlite_base, this_account
from abbe.service.backup.backup import BackupSource, sqlite_file
from abbe.service.backup.backup_files import CAPTURE, DATABASE, HEADS, KEY, Backup, audit_faults, read_backup
from abbe.service.capture.settings import segment_folder
from abbe.service.domain.audit_event import AuditEvent
from abbe.service.errors import BackupRefused
from abbe.service.storage.copying import is_locked, prove_copy, sync_file, users_of
from abbe.service.storage.migrate import known_revisions
from abbe.service.storage.store import Store

BESIDE = ("", "-journal", "-wal", "-shm")
"""A SQLite file and what belongs to it: without its journal a database that was cut off is damaged."""


@dataclass(frozen=True, slots=True)
class Restored:
    """What was brought back. ``aside``: where what was there before lies now."""

    backup: Backup
    database: Path
    records: int
    segments: int
    aside: tuple[Path, ...]


@dataclass(frozen=True, slots=True)
class _Places:
    """Where everything goes."""

    database: Path
    capture: Path
    key: Path
    heads: Path

    def taken(self) -> list[Path]:
        """What is there already."""
        database = [Path(f"{self.database}{ending}") for ending in BESIDE]
        return [path for path in (*database, self.capture, self.key, self.heads) if path.exists()]


def restore(
    folder: Path, into: BackupSource, utcnow: Callable[[], datetime], *, replace: bool = False, key_file: Path | None = None
) -> Restored:
    """Bring a backup back.

    Everything is proved on a copy beside the place before anything there is touched; what was there is renamed, not deleted; the database
    comes last. Whenever this is cut off, there is the old database, the new one, or none - and none half.

    Parameters
    ----------
    folder : Path
        The backup.
    into : BackupSource
        Where to.
    utcnow : callable
        Clock.
    replace : bool
        Whether a database that is there is put aside.
    key_file : Path, optional
        Key of the audit, for a backup without it.

    Raises
    ------
    BackupRefused
        The backup is damaged or of a newer version, its audit was changed, there is a database already, or it is in use.
    StoreError
        The copied database is damaged.
    """
    database = sqlite_file(into.url, "restore")
    backup = read_backup(folder)
    places = _free(into, database, replace=replace)
    part = database.parent / f".{database.name}.restoring-{secrets.token_hex(4)}"
    try:
        part.mkdir(mode=0o700)
        shutil.copytree(backup.folder, part, dirs_exist_ok=True)
        if key_file is not None:
            shutil.copyfile(key_file, part / KEY)
        records = _proved(part, folder)
        aside = _put_aside(places, utcnow()) if replace else ()
        _placed(part, places)
    except OSError as err:
        raise BackupRefused(f"{database} could not be restored: {err}", "look at disk space and rights") from err
    finally:
        shutil.rmtree(part, ignore_errors=True)
    with Store.open(into.url) as store:
        options = {"from": str(folder), "made_utc": str(backup.doc["made_utc"]), "aside": ", ".join(map(str, aside))}
        AuditBook(store, into.url).write(
            AuditEvent(who=this_account(), action="abbe restore", target=str(database), outcome="done", doc=options)
        )
    return Restored(backup, database, records, len(backup.segments), aside)


def _free(into: BackupSource, database: Path, *, replace: bool) -> _Places:
    """Where everything goes, if it may."""
    if not database.parent.is_dir():
        raise BackupRefused(f"folder {database.parent} does not exist", "create it, or give another --store")
    if users := users_of(database):
        raise BackupRefused(f"{database} is in use by process {users[0]}", "stop the service first: systemctl stop abbe")
    if database.exists() and is_locked(database):
        raise BackupRefused(f"{database} is in use: somebody writes it", "stop the service first: systemctl stop abbe")
    places = _Places(database, segment_folder(into.url, into.capture), *files_of(sqlite_base(database)))
    taken = places.taken()
    if taken and not replace:
        raise BackupRefused(f"{taken[0]} exists", "give --replace to put what is there aside, or another --store")
    return places


def _proved(part: Path, backup: Path) -> int:
    """Prove a copied backup; return the number of the audit's records."""
    revision = prove_copy(part / DATABASE)
    if revision not in known_revisions():
        raise BackupRefused(f"{backup} has schema {revision}, which this version of Abbe does not know", "use the Abbe that wrote it")
    key = part / KEY
    records, found = audit_faults(part / DATABASE, part / HEADS, key if key.exists() else None)
    if records and not key.exists():
        raise BackupRefused(f"{backup} has no key of the audit, so its {records} records prove nothing", "give --audit-key FILE")
    if found:
        more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
        raise BackupRefused(f"the audit in {backup} is broken: {found[0]}{more}", "take another backup, or the key that belongs to it")
    return records


def _put_aside(places: _Places, now: datetime) -> tuple[Path, ...]:
    """Rename what is there: database first, then what belongs to it."""
    stamp = f".replaced-{now:%Y%m%dT%H%M%S}"
    moved = []
    for path in places.taken():
        ending = next((one for one in BESIDE[1:] if path == Path(f"{places.database}{one}")), "")
        target = Path(f"{str(path).removesuffix(ending)}{stamp}{ending}")
        if target.exists():
            raise BackupRefused(f"{target} exists", "try again in a second")
        path.rename(target)
        moved.append(target)
    return tuple(moved)


def _placed(part: Path, places: _Places) -> None:
    """Rename everything into its place, the database last."""
    segments, owner = sorted((part / CAPTURE).glob("run-*")), places.database.parent.stat()
    if segments:
        places.capture.mkdir(mode=0o700, parents=True, exist_ok=True)
        _given_to(places.capture, owner)
    moves = [(path, places.capture / path.name) for path in segments]
    moves += [(part / HEADS, places.heads), (part / KEY, places.key), (part / DATABASE, places.database)]
    for source, target in moves:
        if source.exists():
            os.chmod(source, 0o600)
            _given_to(source, owner)
            sync_file(source)
            shutil.move(source, target)  # the audit's folder may be on another disk
    for folder in {target.parent for _, target in moves if target.parent.is_dir()}:
        sync_file(folder)


def _given_to(path: Path, owner: os.stat_result) -> None:
    """A database that root restores gets the owner of its folder: else the service could not write it."""
    if os.geteuid() == 0:
        os.chown(path, owner.st_uid, owner.st_gid)
