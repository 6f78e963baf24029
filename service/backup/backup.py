"""`abbe backup`: copy the database, samples not yet in it, and the audit's files, as they are at one instant, while the service runs.

A backup is a folder with these files and a list of them. A shared backup holds the database in pieces (`abbe.service.backup.pieces`).
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, fields
from datetime import datetime
from importlib.metadata import version
from pathlib import Path

from abbe.service.audit.book import AuditBook, faults, heads_in, this_account
from abbe.service.backup.pieces import PIECES, ListedPieces, check, cut
from abbe.service.capture.settings import CaptureSettings, other_folders, segment_folder
from abbe.service.domain.document import document, record
from abbe.service.domain.service_records import AuditEvent
from abbe.service.errors import BackupRefused, Unusable
from abbe.service.files import is_plain, read_plain
from abbe.service.secrets import mask_secrets
from abbe.service.storage.copying import copy_online, prove_copy, rows_of, sync_file
from abbe.service.storage.engine import parse_url
from abbe.service.storage.store import Store

FORMAT, SHARED_FORMAT = "abbe-backup/1", "abbe-backup/2"
"""Formats of a backup: with the database as one file, and in pieces."""
LIST = "backup.json"
DATABASE = "abbe.sqlite3"
CAPTURE = "capture"
KEY = "audit-key"
HEADS = "audit-head"
MACHINE = "machine.toml"
COUNTED = ("machines", "campaigns", "runs", "chunks", "solutions", "verifications", "proposals", "audit")
_PIECE = 1 << 20
LONGEST_LIST = 64 << 20
ROOM_BYTES = 256 << 20
"""Disk space that has to stay free beside a copy of the database, bytes."""


@dataclass(frozen=True, slots=True)
class ListedFile:
    """Size and SHA-256 of a file of a backup."""

    bytes: int
    sha256: str


@dataclass(frozen=True, slots=True)
class ListedAudit:
    """The audit of a backup: number of its records, whether its key is in the backup, and the faults found when it was copied."""

    records: int
    key: bool
    faults: list[str]


@dataclass(frozen=True, slots=True)
class BackupList:
    """List of a backup's content (``backup.json``).

    ``schema``: schema revision of the database; ``rows``: row counts of its main tables; ``segments``: number of files with samples that
    were not yet in the database; ``files``: all files by path, except the pieces; ``pieces``: the database, if it is not one file.
    """

    format: str
    made_utc: str
    abbe: str
    source: str
    database_id: str
    schema: str
    rows: dict[str, int]
    segments: int
    audit: ListedAudit
    files: dict[str, ListedFile]
    pieces: ListedPieces | None = None

    @property
    def bytes(self) -> int:
        """Size of the backup, bytes."""
        return sum(one.bytes for one in self.files.values()) + (0 if self.pieces is None else self.pieces.bytes)

    @property
    def new_bytes(self) -> int:
        """Size of the parts that no earlier backup holds, bytes."""
        return self.bytes - (0 if self.pieces is None else self.pieces.bytes - self.pieces.new_bytes)


@dataclass(frozen=True, slots=True)
class Backup:
    """A backup whose files match its list."""

    folder: Path
    listed: BackupList

    @property
    def segments(self) -> list[Path]:
        """Segments of the capture (files of samples) that were not yet in the database, or were set aside as damaged."""
        return sorted((self.folder / CAPTURE).glob("run-*"))


def digest_of(path: Path) -> str:
    """SHA-256 of a file. Raises OSError."""
    found = hashlib.sha256()
    with path.open("rb") as file:
        while piece := file.read(_PIECE):
            found.update(piece)
    return found.hexdigest()


def file_list(folder: Path) -> dict[str, ListedFile | None]:
    """Return size and digest of each file below a folder by its relative path, without list and pieces; a link, pipe or device has None.

    Raises OSError.
    """
    found = dict[str, ListedFile | None]()
    for path in sorted(folder.rglob("*")):
        if path.parent == folder / PIECES:
            continue
        if not is_plain(path):  # a link, pipe or device: no backup has one, and a copy would follow it
            found[path.relative_to(folder).as_posix()] = None
        elif path.is_file() and path != folder / LIST:
            found[path.relative_to(folder).as_posix()] = ListedFile(path.stat().st_size, digest_of(path))
    return found


def read_backup(folder: Path) -> Backup:
    """Read a backup and compare each of its files with the list.

    Raises
    ------
    BackupRefused
        The folder is not a backup, or one of a newer version; or a file is missing, additional or changed.
    """
    try:
        doc = json.loads(read_plain(folder / LIST, LONGEST_LIST))
        if doc.get("format") not in {FORMAT, SHARED_FORMAT}:
            known = f"this version of Abbe reads {FORMAT} and {SHARED_FORMAT}"
            raise BackupRefused(f"{folder} cannot be read: its format is {doc.get('format')!r}", known)
        listed = record(BackupList, doc, f"{folder / LIST}")
        wanted, found = listed.files, file_list(folder)
        wrong = sorted(name for name in wanted.keys() | found.keys() if name not in wanted or wanted[name] != found.get(name))
        if not wrong and (listed.pieces is not None or (folder / PIECES).exists()):
            check(folder / PIECES, listed.pieces or ListedPieces(0, 0, []))
    except (FileNotFoundError, NotADirectoryError):
        raise BackupRefused(f"{folder} is not a backup: it has no {LIST}", "give the folder that `abbe backup` made") from None
    except OSError as err:
        raise BackupRefused(f"{folder} cannot be read: {err.strerror}", "look at its rights and at the disk") from None
    except (ValueError, AttributeError, Unusable) as err:
        raise BackupRefused(f"{folder / LIST} is damaged: {err}", "use another backup") from None
    if wrong:
        how = "missing" if wrong[0] not in found else "not part of this backup" if wrong[0] not in wanted else "changed since the backup"
        raise BackupRefused(f"{folder / wrong[0]} is {how}", "use another backup")
    return Backup(folder, listed)


def audit_faults(database: Path, heads: Path, key: Path | None) -> tuple[int, list[str]]:
    """Number of records in the audit of a copied database, and all faults of the audit.

    ``heads``: file with one sealed digest per record; ``key``: file of the audit's key, without which no faults can be found.

    Raises
    ------
    StoreError, AuditBroken, OSError
        A file cannot be read.
    """
    if not rows_of(database, "SELECT 1 FROM sqlite_master WHERE name = 'audit'"):
        return 0, []  # from a version without an audit
    records = _records(database)
    if key is None or not records:
        return len(records), []
    return len(records), faults(records, heads_in(heads), key.read_bytes())


def _records(database: Path) -> list[AuditEvent]:
    """Return the audit of a copied database, in which the documents are JSON text."""
    names = [one.name for one in fields(AuditEvent)]
    rows = (dict(zip(names, row, strict=True)) for row in rows_of(database, f"SELECT {', '.join(names)} FROM audit ORDER BY id"))  # noqa: S608 - our own names
    return [AuditEvent(**row | {"doc": json.loads(row["doc"])}) for row in rows]


def counts(database: Path) -> dict[str, int]:
    """Row counts of the main tables of a copied database."""
    there = {str(row[0]) for row in rows_of(database, "SELECT name FROM sqlite_master WHERE type = 'table'")}
    return {name: int(rows_of(database, f"SELECT count(*) FROM {name}")[0][0]) for name in COUNTED if name in there}  # noqa: S608 - our own names


SERVER_HELP = "copy it with pg_dump --format=custom, bring it back with pg_restore (docs/how-to/backup.md)"


@dataclass(frozen=True, slots=True)
class BackupSource:
    """What a backup copies: the database, samples of the capture that are not in it yet, and optionally the machine file."""

    url: str
    capture: CaptureSettings
    machine_file: Path | None = None


def sqlite_file(url: str, what: str) -> Path:
    """Path of the SQLite file of a URL.

    Raises
    ------
    BackupRefused
        The database is on a server, or in memory.
    """
    parsed = parse_url(url)
    if parsed.drivername != "sqlite":
        raise BackupRefused(f"abbe {what} copies only SQLite files, and {mask_secrets(url)} is on a PostgreSQL server", SERVER_HELP)
    if parsed.database in {None, "", ":memory:"}:
        raise BackupRefused(
            f"abbe {what} needs a SQLite file, and {url} is in memory only", "give the URL of a file, e.g. sqlite:///abbe.sqlite3"
        )
    return Path(str(parsed.database))


def back_up(
    source: BackupSource, target: Path, utcnow: Callable[[], datetime], *, with_key: bool = True, share: bool = False
) -> BackupList:
    """Make a backup: the new folder ``target`` (0700, files 0600), complete or not at all. The service keeps running.

    The backup holds everything that was on the disk at the call. Segments are copied first, because a sample leaves its segment only when
    the database has it; then the database, as it is at one instant; finally the audit's heads up to the last copied record.

    Parameters
    ----------
    with_key : bool
        Include the audit's key. Without it, a holder of the backup cannot forge an audit, and `restore` asks for the key.
    share : bool
        Write the database in pieces, and link pieces that the latest shared backup beside ``target`` already has. The database is first
        copied beside itself, so that ``target``'s disk gets only what is new.

    Returns
    -------
    BackupList
        What the backup holds. ``audit.faults``: faults of the copied audit.

    Raises
    ------
    BackupRefused
        The folder exists or cannot be created, or the database is on a server.
    StoreError
        The database cannot be copied, or the copy is damaged.
    """
    database = sqlite_file(source.url, "backup")
    if not database.is_file():
        raise BackupRefused(f"there is no database {database}", "give -m FILE or --db URL")
    beside = _room_beside(database) if share else None
    part = _new_folder(target)
    copy = beside or part / DATABASE
    try:
        made = _fill(part, database, copy, source, utcnow, with_key=with_key)
        os.rename(part, target)
        sync_file(target.parent)
    except OSError as err:
        raise BackupRefused(
            f"{target} could not be written: {err.strerror}", "check disk space and rights; the partial backup was removed"
        ) from err
    finally:
        shutil.rmtree(part, ignore_errors=True)
        copy.unlink(missing_ok=True)
    with Store.open(source.url) as store:
        options = {"made_utc": made.made_utc, "key": "with" if with_key else "without"}
        AuditBook(store, source.url).write(
            AuditEvent(who=this_account(), action="abbe backup", target=str(target), outcome="done", doc=options)
        )
    return made


def _new_folder(target: Path) -> Path:
    if target.exists():
        raise BackupRefused(f"{target} exists", "give the name of a new folder; a backup never overwrites")
    part = target.parent / f".{target.name}.part-{secrets.token_hex(4)}"
    try:
        part.mkdir(mode=0o700)
    except OSError as err:
        raise BackupRefused(f"{target} cannot be made: {err.strerror}", "give a folder that exists and is writable") from None
    return part


def _room_beside(database: Path) -> Path:
    """Return a new name beside a database, where a copy of it has room."""
    needed, free = database.stat().st_size + ROOM_BYTES, shutil.disk_usage(database.parent).free
    if free < needed:
        raise BackupRefused(
            f"a shared backup needs {needed / 1e6:.0f} MB beside {database}, but only {free / 1e6:.0f} MB are free",
            "free disk space, or leave out --share",
        )
    return database.with_name(f".{database.name}.copy-{secrets.token_hex(4)}")


def _fill(part: Path, database: Path, copy: Path, source: BackupSource, utcnow: Callable[[], datetime], *, with_key: bool) -> BackupList:
    """Fill the folder of a backup. ``copy``: the copied database, in this folder or, if it is to be cut into pieces, outside."""
    made = utcnow().isoformat(timespec="seconds")
    segments = _segments(part / CAPTURE, source)
    copy_online(database, copy)
    revision = prove_copy(copy)
    identity = str(rows_of(copy, "SELECT uid FROM identity")[0][0]) if revision >= "0004" else ""
    audit = _audit(part, copy, source, with_key=with_key)
    if source.machine_file is not None:
        _copy_private(source.machine_file, part / MACHINE)
    whole = copy == part / DATABASE
    pieces = None if whole else cut(copy, part / PIECES, _latest_shared(part.parent, identity))
    listed = BackupList(
        format=FORMAT if whole else SHARED_FORMAT,
        made_utc=made,
        abbe=version("abbe"),
        source=mask_secrets(source.url),
        database_id=identity,
        schema=revision,
        rows=counts(copy),
        segments=segments,
        audit=audit,
        files={name: one for name, one in file_list(part).items() if one is not None},
        pieces=pieces,
    )
    (part / LIST).touch(mode=0o600)
    (part / LIST).write_text(json.dumps(document(listed, stated_only=True), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    for path in [*part.rglob("*"), part]:
        sync_file(path)
    return listed


def _latest_shared(folder: Path, identity: str) -> Path | None:
    """Return the pieces of the latest shared backup of this database in a folder, if any."""
    found = list[tuple[str, Path]]()
    for path in folder.glob(f"[!.]*/{LIST}"):
        with suppress(OSError, ValueError, AttributeError):
            doc = json.loads(read_plain(path, LONGEST_LIST))
            if doc.get("format") == SHARED_FORMAT and doc.get("database_id") == identity:
                found.append((str(doc.get("made_utc")), path.parent / PIECES))
    return max(found, default=("", None))[1]


def _segments(folder: Path, source: BackupSource) -> int:
    """Copy the capture's segments. A segment that vanishes meanwhile is in the database, which is copied afterwards."""
    own = segment_folder(source.url, source.capture)
    found = [path for one in (own, *other_folders(source.url, source.capture, own)) for path in sorted(one.glob("run-*"))]
    if found:
        folder.mkdir(mode=0o700)
    copied = 0
    for path in found:
        target = folder / path.name
        if target.exists():  # of two folders the present one takes precedence
            continue
        try:
            _copy_private(path, target)
        except FileNotFoundError:
            target.unlink(missing_ok=True)
            continue
        copied += 1
    return copied


def _audit(part: Path, copy: Path, source: BackupSource, *, with_key: bool) -> ListedAudit:
    """Copy the audit's files, the heads after the database: every copied record then has its head. Heads of later records are left out."""
    with Store.open(source.url) as store:
        book = AuditBook(store, source.url)
    if not book.key_file.exists():
        return ListedAudit(audit_faults(copy, part / HEADS, None)[0], key=False, faults=[])
    last = int(rows_of(copy, "SELECT coalesce(max(id), 0) FROM audit")[0][0])
    lines = book.head_file.read_text(encoding="ascii", errors="replace").splitlines(keepends=True) if book.head_file.exists() else []
    kept = [line for line in lines if not (number := line.partition(" ")[0]).isdigit() or int(number) <= last]
    (part / HEADS).touch(mode=0o600)
    (part / HEADS).write_text("".join(kept), encoding="ascii", errors="replace")
    records, found = audit_faults(copy, part / HEADS, book.key_file)
    if with_key:
        _copy_private(book.key_file, part / KEY)
    return ListedAudit(records, with_key, found)


def _copy_private(source: Path, target: Path) -> None:
    """Copy a file into a new one with rights 0600."""
    with source.open("rb") as origin, os.fdopen(os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as copy:
        shutil.copyfileobj(origin, copy)
