"""Files that only their owner may read: database, its copies, and the key beside it."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from sqlalchemy.engine import make_url


def private_file(path: Path) -> int:
    """Make a new file with rights 0600; return it open for writing.

    Made by root it belongs to the owner of its folder: `sudo abbe user add` must not leave files that the service cannot read. SQLite does
    the same with its journals.

    Raises
    ------
    OSError
        It is there already, or cannot be made.
    """
    file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        folder = path.parent.stat()
        if folder.st_uid != 0:
            os.fchown(file, folder.st_uid, folder.st_gid)
    return file


def seen_by_others(path: Path) -> str:
    """A warning if others than its owner may read or write a file; empty: they may not, or there is no such file or no such rights."""
    try:
        rights = stat.S_IMODE(path.stat().st_mode)
    except OSError:
        return ""
    if os.name != "posix" or not rights & 0o077:
        return ""
    return f"{path} has rights {rights:04o}: others than its owner may use it - chmod 600 {path}"


def database_seen_by_others(url: str) -> str:
    """The same of a database: empty also for a server's, which guards its own files."""
    parsed = make_url(url)
    return seen_by_others(Path(parsed.database)) if parsed.drivername == "sqlite" and parsed.database else ""
