"""Store methods for the diagnostics: schema, size and age of the database, and what waits in the outbox."""

from __future__ import annotations

import os

from sqlalchemy import Connection, func, select, text

from abbe.service.domain.service_records import StoreHealth
from abbe.service.storage.base import StoreBase
from abbe.service.storage.migrate import head_revision, revision_of
from abbe.service.storage.tables import machines, outbox


class HealthStore(StoreBase):
    """How the database itself is."""

    def health(self) -> StoreHealth:
        """Look at the database; nothing is written."""
        database = self._engine.url.database
        file = str(database) if self._engine.dialect.name == "sqlite" and not self._in_memory and database else ""

        def look(connection: Connection) -> StoreHealth:
            waiting = select(func.count(), func.min(outbox.c.created_utc)).where(outbox.c.sent_utc.is_(None))
            count, oldest = connection.execute(waiting).one()
            since = connection.execute(select(func.min(machines.c.created_utc))).scalar()
            if self._engine.dialect.name == "postgresql":
                size = int(connection.execute(text("select pg_database_size(current_database())")).scalar_one())
            elif file:
                size = sum(os.path.getsize(path) for path in (file, f"{file}-wal") if os.path.exists(path))
            else:
                size = int(connection.execute(text("select page_count * page_size from pragma_page_count, pragma_page_size")).scalar_one())
            revision = revision_of(connection) or ""
            return StoreHealth(revision, head_revision(), file, size, since, int(count), oldest)

        return self._read(look)
