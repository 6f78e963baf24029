"""The database: a `Store` opened by URL, with one writer thread and schema migrations."""

from __future__ import annotations

import sqlite3


def wal_is_safe(version: str = sqlite3.sqlite_version) -> bool:
    """Whether this SQLite version has the fix of the WAL-reset bug, which loses committed data (sqlite.org/wal.html).

    Fixed in 3.51.3 and later, and in 3.44.6+ and 3.50.7+ of their branches.
    """
    number = tuple(int(part) for part in version.split("."))
    return number >= (3, 51, 3) or (number[:2] == (3, 44) and number >= (3, 44, 6)) or (number[:2] == (3, 50) and number >= (3, 50, 7))
