"""A database in pieces, each a file named by its SHA-256: backups in one folder share equal pieces as hard links.

Every backup is complete: deleting one removes only the pieces that no other backup holds.
"""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from abbe.service.errors import BackupRefused
from abbe.service.files import is_plain

PIECES = "pieces"
PIECE_BYTES = 256 << 10


@dataclass(frozen=True, slots=True)
class ListedPieces:
    """The database of a backup: its size, the size of the pieces that no earlier backup had, and the names of all its pieces in order."""

    bytes: int
    new_bytes: int
    names: list[str]


def cut(database: Path, folder: Path, earlier: Path | None) -> ListedPieces:
    """Write a database as pieces into the new ``folder`` (0700, files 0600).

    Undamaged pieces of ``earlier`` are linked if this account owns them and no other account has access, since a link keeps owner and
    rights.

    Raises
    ------
    OSError
        A file cannot be read or written. Where the disk has no hard links, each piece is written.
    """
    folder.mkdir(mode=0o700)
    names, size, new = list[str](), 0, 0
    with database.open("rb") as file:
        while data := file.read(PIECE_BYTES):
            name = hashlib.sha256(data).hexdigest()
            if not (folder / name).exists() and not (earlier is not None and _link(earlier / name, folder / name, data)):
                with os.fdopen(os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as piece:
                    piece.write(data)
                new += len(data)
            names.append(name)
            size += len(data)
    return ListedPieces(size, new, names)


def _link(source: Path, target: Path, data: bytes) -> bool:
    """Link a private piece that holds these bytes; False if there is none, or no link is possible."""
    with suppress(OSError):
        found = source.lstat()
        private = found.st_uid == os.geteuid() and found.st_mode == stat.S_IFREG | 0o600
        if private and found.st_size == len(data) and source.read_bytes() == data:
            os.link(source, target)
            return True
    return False


def join(folder: Path, names: Sequence[str], target: Path) -> None:
    """Write the database of these pieces into a new file (0600). Raises BackupRefused, OSError."""
    with os.fdopen(os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        for data in _read(folder, names):
            file.write(data)


def check(folder: Path, listed: ListedPieces) -> None:
    """Refuse a folder with a missing, damaged or additional piece, or with pieces of a wrong total size. Raises BackupRefused, OSError."""
    present = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    if more := sorted(present - set(listed.names)):
        raise BackupRefused(f"{folder / more[0]} is not part of this backup", "use another backup")
    each = sorted(set(listed.names))
    sizes = dict(zip(each, map(len, _read(folder, each)), strict=True))
    if (found := sum(sizes[name] for name in listed.names)) != listed.bytes:
        raise BackupRefused(f"the pieces in {folder} have {found} bytes, but their list says {listed.bytes} bytes", "use another backup")


def _read(folder: Path, names: Sequence[str]) -> Iterator[bytes]:
    for name in names:
        path = folder / name
        if os.path.lexists(path) and is_plain(path) and 0 < path.stat().st_size <= PIECE_BYTES:
            data = path.read_bytes()
            if hashlib.sha256(data).hexdigest() == name:
                yield data
                continue
        raise BackupRefused(f"{path} is {'changed since the backup' if os.path.lexists(path) else 'missing'}", "use another backup")
