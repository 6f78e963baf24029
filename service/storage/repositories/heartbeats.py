"""Store methods for what each machine's service says of itself: one row a machine, written anew each time."""

from __future__ import annotations

from sqlalchemy import Connection, select
from sqlalchemy.dialects.postgresql import insert as pg_insert
from sqlalchemy.dialects.sqlite import insert as sqlite_insert

from abbe.service.domain.document import Doc
from abbe.service.domain.owner import Owner, this_process
from abbe.service.domain.service_records import HeartbeatRecord
from abbe.service.storage.base import StoreBase
from abbe.service.storage.tables import heartbeats, machines


class HeartbeatStore(StoreBase):
    """The services that write to this database."""

    def put_heartbeat(self, machine: str, doc: Doc) -> None:
        """Write what this process, the service of a machine, says of itself now."""
        me = this_process()
        said = {"doc": doc, "seen_utc": self._now(), "owner_host": me.host, "owner_pid": me.pid, "owner_start": me.start}

        def work(connection: Connection) -> None:
            fresh = pg_insert(heartbeats) if connection.dialect.name == "postgresql" else sqlite_insert(heartbeats)
            statement = fresh.values(machine=machine, **said)
            connection.execute(statement.on_conflict_do_update(index_elements=[heartbeats.c.machine], set_=said))

        self._write(work)

    def heartbeats(self) -> dict[str, HeartbeatRecord]:
        """What the services said last, by machine."""
        query = select(heartbeats).order_by(heartbeats.c.machine)
        rows = self._read(lambda connection: connection.execute(query).all())
        return {r.machine: HeartbeatRecord(r.machine, r.doc, r.seen_utc, Owner(r.owner_host, r.owner_pid, r.owner_start)) for r in rows}

    def machine_names(self) -> list[str]:
        """Names of all machines that this database knows, whatever descriptions they have had."""
        query = select(machines.c.name).union(select(heartbeats.c.machine))
        return sorted(str(row[0]) for row in self._read(lambda connection: connection.execute(query).all()))
