"""The audit: append-only; each event is chained to the one before it within one transaction."""

from __future__ import annotations

from collections.abc import Callable

from sqlalchemy import Connection, text

from abbe.service.domain.audit_event import AuditEvent
from abbe.service.storage.mapping import AUDIT
from abbe.service.storage.repository import Repository, insert_row
from abbe.service.storage.tables import audit


class Audit(Repository):
    """The audit of this database."""

    def append(self, make: Callable[[AuditEvent | None, str], AuditEvent]) -> AuditEvent:
        """Append the event that ``make(last event, present UTC)`` makes. Two processes wait for each other: the chain never forks."""

        def work(connection: Connection) -> AuditEvent:
            if self._db.is_postgresql:  # on SQLite BEGIN IMMEDIATE has shut out others already
                connection.execute(text("LOCK TABLE audit IN EXCLUSIVE MODE"))
            last = connection.execute(AUDIT.select().order_by(audit.c.id.desc()).limit(1)).first()
            event = make(None if last is None else AUDIT.read(last), self._db.now())
            insert_row(connection, audit, **AUDIT.values(event))
            return event

        return self._db.commit(work)

    def events(self, last: int | None = None) -> list[AuditEvent]:
        """Read the audit, oldest first; only the ``last`` events if given."""
        return self._all(AUDIT, newest=True, limit=last)[::-1]
