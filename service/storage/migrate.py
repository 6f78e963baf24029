"""Migrate a database to the schema of this version, under a lock; a SQLite file is copied first."""

from __future__ import annotations

import os
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy import Connection, Engine, inspect

from abbe.service.errors import StoreError
from abbe.service.secrets import mask_secrets
from abbe.service.storage.engine import private_file

if TYPE_CHECKING:
    from alembic.config import Config

_SCRIPTS = "abbe.service.storage:migrations"
_VERSIONS = "abbe.service.storage.migrations.versions"
_TABLE = "alembic_version"
_PG_LOCK = 0x41626265  # "Abbe": two services starting at once migrate one after the other


@cache
def known_revisions() -> tuple[str, ...]:
    """Every schema revision that this program can upgrade, oldest first, from the files ``rNNNN_what.py``.

    Not from Alembic, which takes a quarter of a second to import: nearly every database is up to date.
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
            "use the Abbe that wrote it, or another database",
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
