"""Open the database: URL, access rights of files, SQLite's safety settings, translation of database errors, and migration.

A database is migrated to the schema of this version under a lock; a SQLite file is copied first.
"""

from __future__ import annotations

import json
import os
import sqlite3
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import Connection, Engine, create_engine, event, exc, inspect
from sqlalchemy.engine import URL, make_url
from sqlalchemy.pool import StaticPool

from abbe.service.errors import StoreError
from abbe.service.secrets import mask_secrets
from abbe.service.storage import wal_is_safe

if TYPE_CHECKING:
    from alembic.config import Config


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
    """Return a warning if accounts other than the owner may use a file; empty for a private or missing file, or without POSIX rights."""
    try:
        rights = stat.S_IMODE(path.stat().st_mode)
    except OSError:
        return ""
    if os.name != "posix" or not rights & 0o077:
        return ""
    return f"{path} has rights {rights:04o}: others than its owner may use it - chmod 600 {path}"


def database_readable_by_others(url: str) -> str:
    """Return the warning of `readable_by_others` for a SQLite database; empty for a server, which guards its own files."""
    parsed = make_url(url)
    return readable_by_others(Path(parsed.database)) if parsed.drivername == "sqlite" and parsed.database else ""


DEFAULT_URL = "sqlite:///abbe.sqlite3"
BUSY_TIMEOUT_MS = 5000
JOURNAL_LIMIT_BYTES = 64 * 2**20
READ_ONLY_OPTION = "abbe_reads_only"
_SQLITE_MAGIC = b"SQLite format 3\x00"
_JOURNAL_MODE = "WAL" if wal_is_safe() else "PERSIST"


def resolve_url(url: str, base: Path | None = None) -> str:
    """Make a relative SQLite path relative to ``base``, the folder of the machine file, instead of to the working directory.

    Without ``base`` the URL stays as it is.
    """
    parsed = parse_url(url)
    if base is None or not _is_sqlite_file(parsed) or Path(str(parsed.database)).is_absolute():
        return url
    return parsed.set(database=str((base / str(parsed.database)).resolve())).render_as_string(hide_password=False)


def parse_url(url: str) -> URL:
    """Parse a database URL; PostgreSQL always gets the psycopg driver.

    Raises
    ------
    StoreError
        The URL is not one of SQLite or PostgreSQL; the remedy shows examples.
    """
    try:
        parsed = make_url(url)
    except exc.ArgumentError:
        raise StoreError(f"database URL {mask_secrets(url)!r} cannot be understood", _URL_HELP) from None
    if parsed.drivername in {"postgresql", "postgres"}:
        parsed = parsed.set(drivername="postgresql+psycopg")
    if parsed.drivername not in {"sqlite", "postgresql+psycopg"}:
        raise StoreError(f"database {parsed.drivername!r} is not supported", _URL_HELP)
    return parsed


_URL_HELP = "write e.g. sqlite:///abbe.sqlite3 or postgresql://user@host/name"


def make_engine(url: str) -> Engine:
    """Create the engine with Abbe's settings; create an empty private file for a new SQLite database. No connection is opened.

    On SQLite, transactions start with BEGIN IMMEDIATE unless the connection has the option ``READ_ONLY_OPTION``.

    Raises
    ------
    StoreError
        The URL is wrong, the file is not a database, its folder is missing, or the driver is not installed.
    """
    parsed = parse_url(url)
    options: dict[str, Any] = {"pool_pre_ping": True}
    if parsed.drivername == "sqlite":
        _check_file(parsed)
        options = {"connect_args": {"check_same_thread": False}} | ({} if _is_sqlite_file(parsed) else {"poolclass": StaticPool})
    try:
        engine = create_engine(parsed, json_serializer=_to_json, **options)
    except ModuleNotFoundError as err:
        raise StoreError(f"PostgreSQL needs the package {err.name!r}", "pip install 'abbe[postgres]'") from None
    if parsed.drivername == "sqlite":
        event.listen(engine, "connect", _set_pragmas)
        event.listen(engine, "begin", _begin)
    return engine


@contextmanager
def translated(url: str) -> Iterator[None]:
    """Turn any SQLAlchemy error into one StoreError that names the database and hides its password."""
    try:
        yield
    except exc.OperationalError as err:
        raise StoreError(f"database {mask_secrets(url)}: {_first_line(err)}", _remedy(str(err.orig))) from err
    except exc.SQLAlchemyError as err:
        raise StoreError(f"database {mask_secrets(url)}: {_first_line(err)}") from err


def _to_json(value: Any) -> str:
    try:
        return json.dumps(value, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
    except ValueError as err:
        raise StoreError(f"a document with NaN or Infinity cannot be stored ({err})", "give null where there is no value") from None


def _first_line(err: exc.SQLAlchemyError) -> str:
    inner = getattr(err, "orig", None) or err
    return mask_secrets(str(inner).strip().splitlines()[0] if str(inner).strip() else type(inner).__name__)


def _remedy(text: str) -> str:
    if "locked" in text:
        return "another process is writing: stop it or try again"
    if "full" in text:
        return "free disk space"
    if "readonly" in text or "unable to open" in text:
        return "check that the folder exists and is writable"
    if "password" in text or "authentication" in text:
        return "check user and password in the URL"
    if "connection" in text:
        return "check that the database server runs at this address"
    return ""


def _is_sqlite_file(parsed: URL) -> bool:
    return parsed.drivername == "sqlite" and parsed.database not in {None, "", ":memory:"}


def _check_file(parsed: URL) -> None:
    if not _is_sqlite_file(parsed):
        return
    path = Path(str(parsed.database))
    if not path.parent.is_dir():
        raise StoreError(f"database {path}: folder {path.parent} does not exist", "create it or give another --db")
    if path.is_dir():
        raise StoreError(f"database {path} is a folder", "give a file name")
    try:
        with path.open("rb") as file:
            head = file.read(len(_SQLITE_MAGIC))
    except FileNotFoundError:
        _make_private(path)
        return
    except OSError as err:
        raise StoreError(f"database {path} cannot be read: {err.strerror}", "check its access rights") from None
    if head not in {b"", _SQLITE_MAGIC}:
        raise StoreError(f"{path} is not a SQLite database", "give the file that `abbe` made, or a new name")


def _make_private(path: Path) -> None:
    """Create an empty file for its owner only, before SQLite creates one that others can read; journals inherit its rights."""
    try:
        os.close(private_file(path))
    except FileExistsError:
        return  # another process was first
    except OSError as err:
        raise StoreError(f"database {path} cannot be created: {err.strerror}", "check that the folder is writable") from None


def _set_pragmas(connection: sqlite3.Connection, _record: object) -> None:
    connection.isolation_level = None  # we issue BEGIN ourselves: the module starts transactions too late
    cursor = connection.cursor()
    try:
        cursor.execute(f"PRAGMA busy_timeout={BUSY_TIMEOUT_MS}")
        cursor.execute(f"PRAGMA journal_mode={_JOURNAL_MODE}")
        cursor.execute("PRAGMA synchronous=FULL")
        cursor.execute("PRAGMA foreign_keys=ON")
        cursor.execute("PRAGMA trusted_schema=OFF")
        cursor.execute(f"PRAGMA journal_size_limit={JOURNAL_LIMIT_BYTES}")
    finally:
        cursor.close()


def _begin(connection: Connection) -> None:
    reads_only = connection.get_execution_options().get(READ_ONLY_OPTION, False)
    connection.exec_driver_sql("BEGIN" if reads_only else "BEGIN IMMEDIATE")


_SCRIPTS = "abbe.service.storage:migrations"
_VERSIONS = "abbe.service.storage.migrations.versions"
_TABLE = "alembic_version"
_PG_LOCK = 0x41626265  # "Abbe": two services starting at once migrate one after the other


@cache
def known_revisions() -> tuple[str, ...]:
    """Every schema revision that this program can upgrade, oldest first, from the files ``rNNNN_what.py``.

    Alembic takes a quarter of a second to import, and nearly every database is up to date: so this function does without Alembic.
    """
    names = sorted(entry.name for entry in files(_VERSIONS).iterdir() if entry.name.startswith("r") and entry.name.endswith(".py"))
    return tuple(name[1:5] for name in names)


def head_revision() -> str:
    """The schema revision of this program."""
    return known_revisions()[-1]


def current_revision(engine: Engine) -> str | None:
    """The schema revision of a database; None for an empty one."""
    with engine.begin() as connection:
        return revision_of(connection)


def revision_of(connection: Connection) -> str | None:
    """The schema revision of the database of a connection; None for an empty one."""
    if not inspect(connection).has_table(_TABLE):
        return None
    found = connection.exec_driver_sql(f"SELECT version_num FROM {_TABLE}").scalar()  # noqa: S608 - a name of our own
    return None if found is None else str(found)


def upgrade(engine: Engine, target: str = "head") -> None:
    """Upgrade the schema to a revision; does nothing if it is up to date.

    Raises
    ------
    StoreError
        A newer version of Abbe wrote the database, or one from before the first release.
    """
    before = current_revision(engine)
    if before == head_revision() and target == "head":
        return
    _require_known(engine, before)
    if before is not None:
        _backup(engine, before)
    from alembic import command

    with engine.begin() as connection:
        _lock(connection)
        command.upgrade(_config(connection), target)


def downgrade(engine: Engine, target: str = "base") -> None:
    """Undo schema changes down to a revision; the data of removed tables are lost. ``"base"`` removes every table."""
    from alembic import command

    with engine.begin() as connection:
        _lock(connection)
        command.downgrade(_config(connection), target)


def _config(connection: Connection | None = None) -> Config:
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", _SCRIPTS)
    config.set_main_option("path_separator", "os")
    config.attributes["connection"] = connection
    return config


def _require_known(engine: Engine, revision: str | None) -> None:
    if revision is not None and revision not in known_revisions():
        raise StoreError(
            f"database {mask_secrets(str(engine.url))} has schema {revision}, which this version of Abbe does not know",
            "use the version of Abbe that wrote it, or another database",
        )


def _lock(connection: Connection) -> None:
    # SQLite's BEGIN IMMEDIATE already keeps others out.
    if connection.dialect.name == "postgresql":
        connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({_PG_LOCK})")


def _backup(engine: Engine, revision: str) -> None:
    database = engine.url.database
    if engine.dialect.name != "sqlite" or not database or database == ":memory:":
        return  # servers have their own backups
    copy = Path(f"{database}.before-{revision}")
    if copy.exists():
        return
    os.close(private_file(copy))  # VACUUM INTO accepts an empty file and keeps its rights
    raw = engine.raw_connection()  # VACUUM must run outside of any transaction, also of those that the engine begins
    try:
        raw.cursor().execute("VACUUM INTO ?", (str(copy),))
    finally:
        raw.close()
