"""Store methods for the audit: only ever appended, each record made on the one before it within one transaction."""

from __future__ import annotations

from collections.abc import Callable

from sqlalchemy import Connection, insert, text

from abbe.service.domain.audit_event import AuditEvent
from abbe.service.errors import StoreError
from abbe.service.storage.base import StoreBase
from abbe.service.storage.mapping import RecordMapping
from abbe.service.storage.tables_people import audit

AUDIT = RecordMapping(AuditEvent, audit)


class AuditStore(StoreBase):
    """The audit of this database."""

    def append_audit(self, make: Callable[[AuditEvent | None, str], AuditEvent]) -> AuditEvent:
        """Append the record that ``make(last record, present UTC)`` makes. Two processes wait for each other: the chain never forks."""

        def work(connection: Connection) -> AuditEvent:
            if self._engine.dialect.name == "postgresql":  # SQLite's BEGIN IMMEDIATE has shut out the others already
                connection.execute(text("LOCK TABLE audit IN EXCLUSIVE MODE"))
            row = connection.execute(AUDIT.select().order_by(audit.c.id.desc()).limit(1)).first()
            record = make(None if row is None else AUDIT.read(row), self._now())
            connection.execute(insert(audit).values(AUDIT.values(record)))
            return record

        return self._write(work)

    def can_write(self) -> None:
        """Make sure that something can be written now; writes nothing.

        Raises
        ------
        StoreError
            It cannot: read-only, locked by another process, gone.
        """
        # Of SQLite BEGIN IMMEDIATE asks for all that a write needs; a server says itself whether it takes writes.
        read_only = text("SELECT current_setting('transaction_read_only')")

        def work(connection: Connection) -> None:
            if self._engine.dialect.name == "postgresql" and connection.execute(read_only).scalar_one() == "on":
                raise StoreError(f"database {self.url} takes no writes", "use the server that does")

        self._write(work)

    def audit(self, last: int | None = None) -> list[AuditEvent]:
        """Read the audit, oldest first; only the ``last`` records if given."""
        query = AUDIT.select().order_by(audit.c.id.desc())
        query = query if last is None else query.limit(last)
        rows = self._read(lambda connection: connection.execute(query).all())
        return [AUDIT.read(row) for row in reversed(rows)]
