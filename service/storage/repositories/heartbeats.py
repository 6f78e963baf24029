"""Heartbeats: the latest state of each machine's service, one row per machine, overwritten each time."""

from __future__ import annotations

from sqlalchemy import Connection

from abbe.service.domain.document import Doc
from abbe.service.domain.owner import this_process
from abbe.service.domain.service_records import HeartbeatRecord
from abbe.service.storage.mapping import HEARTBEAT, owner_of
from abbe.service.storage.repository import Repository, dialect_insert
from abbe.service.storage.tables import heartbeats


class Heartbeats(Repository):
    """Heartbeats of the services that use this database."""

    def put(self, machine: str, doc: Doc) -> None:
        """Write the present state of this process as the service of a machine."""
        values = {"doc": doc, "seen_utc": self._db.now(), **owner_of(heartbeats).values(this_process())}

        def work(connection: Connection) -> None:
            statement = dialect_insert(connection, heartbeats).values(machine=machine, **values)
            connection.execute(statement.on_conflict_do_update(index_elements=[heartbeats.c.machine], set_=values))

        self._db.commit(work)

    def all(self) -> dict[str, HeartbeatRecord]:
        """The latest state of each service, by machine."""
        return {one.machine: one for one in self._all(HEARTBEAT, order=heartbeats.c.machine)}
