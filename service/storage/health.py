"""The state of the database itself, for the diagnostics: schema, size, age, and how many messages wait."""

from __future__ import annotations

import os

from sqlalchemy import Connection, func, select, text

from abbe.service.domain.service_records import StoreHealth
from abbe.service.storage.database import Database
from abbe.service.storage.migrate import head_revision, revision_of
from abbe.service.storage.tables import machines, outbox


def health_of(database: Database) -> StoreHealth:
    """Look at a database; nothing is written."""
    name = database.engine.url.database
    file = str(name) if not database.is_postgresql and not database.in_memory and name else ""

    def look(connection: Connection) -> StoreHealth:
        waiting = select(func.count(), func.min(outbox.c.created_utc)).where(outbox.c.sent_utc.is_(None))
        count, oldest = connection.execute(waiting).one()
        since = connection.execute(select(func.min(machines.c.created_utc))).scalar()
        revision = revision_of(connection) or ""
        return StoreHealth(revision, head_revision(), file, _size_b(connection, file), since, int(count), oldest)

    return database.read(look)


def _size_b(connection: Connection, file: str) -> int:
    if file:
        return sum(os.path.getsize(path) for path in (file, f"{file}-wal") if os.path.exists(path))
    if connection.dialect.name == "postgresql":
        return int(connection.execute(text("select pg_database_size(current_database())")).scalar_one())
    return int(connection.execute(text("select page_count * page_size from pragma_page_count, pragma_page_size")).scalar_one())
