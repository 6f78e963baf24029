"""Content of a backup: a folder with the database, samples not yet in it, the audit's files, and a list of all files."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from abbe.service.audit.book import heads_in
from abbe.service.audit.chain import faults
from abbe.service.domain.audit_event import AuditEvent
from abbe.service.errors import BackupRefused
from abbe.service.files import is_plain, read_plain
from abbe.service.storage.copying import rows_of

FORMAT = "abbe-backup/1"
LIST = "backup.json"
DATABASE = "abbe.sqlite3"
CAPTURE = "capture"
KEY = "audit-key"
HEADS = "audit-head"
MACHINE = "machine.toml"
COUNTED = ("machines", "campaigns", "runs", "chunks", "solutions", "verifications", "proposals", "audit")
_PIECE = 1 << 20
LONGEST_LIST = 64 << 20


@dataclass(frozen=True, slots=True)
class Backup:
    """A backup whose files match its list, ``doc``."""

    folder: Path
    doc: dict[str, Any]

    @property
    def database(self) -> Path:
        """The copied database."""
        return self.folder / DATABASE

    @property
    def segments(self) -> list[Path]:
        """Segments of the capture that were not yet in the database, or were set aside."""
        return sorted((self.folder / CAPTURE).glob("run-*"))


def digest_of(path: Path) -> str:
    """SHA-256 of a file. Raises OSError."""
    found = hashlib.sha256()
    with path.open("rb") as file:
        while piece := file.read(_PIECE):
            found.update(piece)
    return found.hexdigest()


def file_list(folder: Path) -> dict[str, dict[str, Any]]:
    """Size and digest of every file below a folder except the list, by relative path. Raises OSError."""
    found = dict[str, dict[str, Any]]()
    for path in sorted(folder.rglob("*")):
        if not is_plain(path):  # a link, pipe or device: no backup has one, and a copy would follow it
            found[path.relative_to(folder).as_posix()] = {}
        elif path.is_file() and path != folder / LIST:
            found[path.relative_to(folder).as_posix()] = {"bytes": path.stat().st_size, "sha256": digest_of(path)}
    return found


def read_backup(folder: Path) -> Backup:
    """Read a backup and compare each of its files with the list.

    Raises
    ------
    BackupRefused
        The folder is no backup, or one of a newer version; or names a file that is missing, additional or changed.
    """
    try:
        doc = json.loads(read_plain(folder / LIST, LONGEST_LIST))
        if doc.get("format") != FORMAT:
            raise BackupRefused(f"{folder} is a backup of the format {doc.get('format')!r}", f"this version of Abbe reads {FORMAT}")
        wanted, found = doc["files"], file_list(folder)
        wrong = sorted(name for name in wanted.keys() | found.keys() if wanted.get(name) != found.get(name))
    except FileNotFoundError:
        raise BackupRefused(f"{folder} is no backup: it has no {LIST}", "give the folder that `abbe backup` made") from None
    except OSError as err:
        raise BackupRefused(f"{folder} cannot be read: {err.strerror}", "look at its rights and at the disk") from None
    except (ValueError, AttributeError, KeyError) as err:
        raise BackupRefused(f"{folder / LIST} is damaged: {err}", "take another backup") from None
    if wrong:
        how = "missing" if wrong[0] not in found else "not of this backup" if wrong[0] not in wanted else "not as it was written"
        raise BackupRefused(f"{folder / wrong[0]} is {how}", "take another backup")
    return Backup(folder, doc)


def audit_faults(database: Path, heads: Path, key: Path | None) -> tuple[int, list[str]]:
    """Number of records in the audit of a copied database, and all their faults.

    Without a key the audit cannot be checked, and the list of faults is empty.

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
    """The audit of a copied database, whose documents are text."""
    names = [one.name for one in fields(AuditEvent)]
    rows = (dict(zip(names, row, strict=True)) for row in rows_of(database, f"SELECT {', '.join(names)} FROM audit ORDER BY id"))  # noqa: S608 - our own names
    return [AuditEvent(**row | {"doc": json.loads(row["doc"])}) for row in rows]


def counts(database: Path) -> dict[str, int]:
    """Row counts of the main tables of a copied database."""
    there = {str(row[0]) for row in rows_of(database, "SELECT name FROM sqlite_master WHERE type = 'table'")}
    return {name: int(rows_of(database, f"SELECT count(*) FROM {name}")[0][0]) for name in COUNTED if name in there}  # noqa: S608 - our own names
