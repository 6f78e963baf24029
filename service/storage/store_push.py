"""Store methods for the journal of pushes: only ever appended, each entry on the one before it."""

from __future__ import annotations

from sqlalchemy import Connection, func, insert, select

from service.errors import StoreError
from service.storage.base import StoreBase
from service.storage.records import PushEntryRecord
from service.storage.store_campaigns import new_id
from service.storage.tables import push_entries


class PushStore(StoreBase):
    """Journals of pushes, one chain for each machine."""

    def add_push_entry(self, entry: PushEntryRecord) -> int:
        """Append an entry to a machine's chain, if the entry before it is still the last one. On return it is on disk.

        Parameters
        ----------
        entry : PushEntryRecord
            Its ``id`` is given by the database and ignored here.

        Returns
        -------
        int
            Id.

        Raises
        ------
        StoreError
            Another process has written an entry meanwhile, or it cannot be written.
        """

        def work(connection: Connection) -> int:
            query = select(push_entries.c.digest).where(push_entries.c.machine == entry.machine).order_by(push_entries.c.id.desc()).limit(1)
            head = connection.execute(query).scalar()
            if head is not None and head != entry.prev:
                raise StoreError(
                    f"push {entry.push} of {entry.machine}: somebody else has written into the journal meanwhile",
                    "another process pushes or recovers on this machine: wait until it has ended",
                )
            names = ("machine", "push", "seq", "state", "doc", "utc", "prev", "digest")
            return new_id(connection, insert(push_entries).values({name: getattr(entry, name) for name in names}))

        return self._write(work)

    def push_entries(self, machine: str) -> list[PushEntryRecord]:
        """Read the journal of all pushes of a machine from its beginning."""
        query = select(push_entries).where(push_entries.c.machine == machine).order_by(push_entries.c.id)
        return [PushEntryRecord(*row) for row in self._read(lambda connection: connection.execute(query).all())]

    def last_push(self, machine: str) -> list[PushEntryRecord]:
        """Read the journal of the last push of a machine; empty if there was none."""
        latest = select(func.max(push_entries.c.push)).where(push_entries.c.machine == machine).scalar_subquery()
        query = select(push_entries).where(push_entries.c.machine == machine, push_entries.c.push == latest).order_by(push_entries.c.id)
        return [PushEntryRecord(*row) for row in self._read(lambda connection: connection.execute(query).all())]
