"""Bring a database to the schema of this version, under a lock, with a backup copy of a SQLite file first."""

from __future__ import annotations

from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, Engine

from service.errors import StoreError
from service.secrets import mask_secrets

_PG_LOCK = 0x41626265  # "Abbe": two services starting at once migrate one after the other


def head_revision() -> str:
    """Name the schema revision of this program.

    Returns
    -------
    str
        Alembic revision id.
    """
    return str(ScriptDirectory.from_config(_config()).get_current_head())


def current_revision(engine: Engine) -> str | None:
    """Read the schema revision of a database.

    Parameters
    ----------
    engine : Engine
        The database.

    Returns
    -------
    str or None
        None for an empty database.
    """
    with engine.begin() as connection:
        return MigrationContext.configure(connection).get_current_revision()


def upgrade(engine: Engine, target: str = "head") -> None:
    """Upgrade the schema; nothing happens if it is up to date.

    Parameters
    ----------
    engine : Engine
        The database.
    target : str
        Revision to reach.

    Raises
    ------
    StoreError
        If the database was written by a newer version of Abbe.
    """
    script = ScriptDirectory.from_config(_config())
    before = current_revision(engine)
    if before == script.get_current_head() and target == "head":
        return
    _require_known(engine, script, before)
    if before is not None:
        _backup(engine, before)
    with engine.begin() as connection:
        _lock(connection)
        command.upgrade(_config(connection), target)


def downgrade(engine: Engine, target: str = "base") -> None:
    """Take schema changes back; data of removed tables are lost.

    Parameters
    ----------
    engine : Engine
        The database.
    target : str
        Revision to reach; ``"base"`` removes every table.
    """
    with engine.begin() as connection:
        _lock(connection)
        command.downgrade(_config(connection), target)


def _config(connection: Connection | None = None) -> Config:
    config = Config()
    config.set_main_option("script_location", "service.storage:migrations")
    config.set_main_option("path_separator", "os")
    config.attributes["connection"] = connection
    return config


def _require_known(engine: Engine, script: ScriptDirectory, revision: str | None) -> None:
    known = {entry.revision for entry in script.walk_revisions()}
    if revision is not None and revision not in known:
        raise StoreError(
            f"database {mask_secrets(str(engine.url))} has schema {revision}, which this version of Abbe does not know",
            "use the newer Abbe that wrote it, or another database",
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
    raw = engine.raw_connection()  # VACUUM must stand outside of any transaction, also of those that the engine begins
    try:
        raw.cursor().execute("VACUUM INTO ?", (str(copy),))
    finally:
        raw.close()
