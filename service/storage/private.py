"""Files that only their owner may read: database, its copies, and the key beside it."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from sqlalchemy.engine import make_url


def private_file(path: Path) -> int:
    """Create a file with rights 0600; return it open for writing.

    If root creates it, it gets the owner of its folder: `sudo abbe user add` must not leave files that the service cannot read. SQLite
    does the same with its journals.

    Raises
    ------
    OSError
        The file exists or cannot be created.
    """
    file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        folder = path.parent.stat()
        if folder.st_uid != 0:
            os.fchown(file, folder.st_uid, folder.st_gid)
    return file


def readable_by_others(path: Path) -> str:
    """A warning if accounts other than its owner may use a file; empty if not, or if there is no file or no POSIX rights."""
    try:
        rights = stat.S_IMODE(path.stat().st_mode)
    except OSError:
        return ""
    if os.name != "posix" or not rights & 0o077:
        return ""
    return f"{path} has rights {rights:04o}: others than its owner may use it - chmod 600 {path}"


def database_readable_by_others(url: str) -> str:
    """The same for a SQLite database; empty for a server, which guards its own files."""
    parsed = make_url(url)
    return readable_by_others(Path(parsed.database)) if parsed.drivername == "sqlite" and parsed.database else ""
