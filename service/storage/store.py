"""The store: a database with a repository for each aggregate."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime

from sqlalchemy import Connection, Engine, func, select, text

from abbe.service.domain.service_records import StoreHealth
from abbe.service.storage.database import Database
from abbe.service.storage.engine import head_revision, revision_of
from abbe.service.storage.repositories.measured import Campaigns, Checkpoints, Chunks, Machines, Runs
from abbe.service.storage.repositories.pages import Pages
from abbe.service.storage.repositories.people import People
from abbe.service.storage.repositories.results import CompensationTables, Discoveries, Models, Proposals, Pushes, Solutions, Verifications
from abbe.service.storage.repositories.service_records import Alarms, Audit, Heartbeats, Outbox, Replies, Slots
from abbe.service.storage.tables import identity, machines, outbox


class Store(Database):
    """All repositories of one database. Any thread may call; writes run one after the other in one thread.

    Open it with ``Store.open(url)``; in coroutines use ``await store.write(store.runs.start, ...)``.
    """

    def __init__(self, engine: Engine, writer: ThreadPoolExecutor, utcnow: Callable[[], datetime]) -> None:
        super().__init__(engine, writer, utcnow)
        self.machines, self.campaigns = Machines(self), Campaigns(self)
        self.runs, self.chunks, self.checkpoints = Runs(self), Chunks(self), Checkpoints(self)
        self.solutions, self.tables, self.verifications = Solutions(self), CompensationTables(self), Verifications(self)
        self.discoveries, self.models = Discoveries(self), Models(self)
        self.proposals, self.pushes = Proposals(self), Pushes(self)
        self.alarms, self.slots, self.heartbeats = Alarms(self), Slots(self), Heartbeats(self)
        self.outbox, self.replies = Outbox(self), Replies(self)
        self.people, self.audit = People(self), Audit(self)
        self.pages = Pages(self)

    def database_id(self) -> str:
        """Identifier of the database, 32 hex digits, given when its tables were created and independent of its address."""
        return str(self.read(lambda connection: connection.execute(select(identity.c.uid)).scalar_one()))

    def health(self) -> StoreHealth:
        """State of the database for diagnostics: schema, size, age, waiting messages; writes nothing."""
        name = self.engine.url.database
        file = str(name) if not self.is_postgresql and not self.in_memory and name else ""

        def look(connection: Connection) -> StoreHealth:
            waiting = select(func.count(), func.min(outbox.c.created_utc)).where(outbox.c.sent_utc.is_(None))
            count, oldest = connection.execute(waiting).one()
            since = connection.execute(select(func.min(machines.c.created_utc))).scalar()
            revision = revision_of(connection) or ""
            return StoreHealth(revision, head_revision(), file, _size_b(connection, file), since, int(count), oldest)

        return self.read(look)


def _size_b(connection: Connection, file: str) -> int:
    if file:
        return sum(os.path.getsize(path) for path in (file, f"{file}-wal") if os.path.exists(path))
    if connection.dialect.name == "postgresql":
        return int(connection.execute(text("select pg_database_size(current_database())")).scalar_one())
    return int(connection.execute(text("select page_count * page_size from pragma_page_count, pragma_page_size")).scalar_one())
