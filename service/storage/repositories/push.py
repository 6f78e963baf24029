"""Store methods for the journal of pushes: only ever appended, each entry on the one before it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from sqlalchemy import Connection, Row, func, insert, null, select

from abbe.service.domain.decisions import PushEntryRecord
from abbe.service.errors import StoreError
from abbe.service.storage.base import StoreBase
from abbe.service.storage.mapping import RecordMapping
from abbe.service.storage.repositories.campaigns import new_id
from abbe.service.storage.tables import push_entries

MARKS = ("base_crc", "crc", "accepted_crc", "machine", "control", "by")
"""Keys of an entry's document that say which tables, whose, and who vouched."""
NAME_LENGTH = 200


def chain_of(begun: Sequence[tuple[str, str, str]], machine: str, control: str) -> str:
    """Which journal is that of a control.

    Parameters
    ----------
    begun : sequence of tuple
        First entries of pushes, newest first: journal, name of the machine, control (empty: an older version did not note it).
    machine, control : str
        Name and control of the machine; without a control the name decides: the journal that it was last used in.
    """
    if not control:
        return next((chain for chain, name, _ in begun if name == machine), machine)
    last: dict[str, tuple[str, str]] = {}
    for chain, name, at in begun:
        last.setdefault(chain, (name, at))
    # An address that a control has left says nothing of who is there now: the last one of each journal counts.
    own = next((chain for chain, (_, at) in last.items() if at == control), None)
    if own is not None:
        return own
    # A control that is nowhere noted: at a new address, or pushed into by an older version. The name's journal is its, unless a machine of
    # another name has gone on with that. An open push in it is held against the control (`abbe.service.tables.whose_push`).
    named = next((chain for chain, (name, _) in last.items() if name == machine), None)
    if named is not None:
        return named
    return machine if machine not in last else f"{machine} ({control})"[:NAME_LENGTH]


def _mark(row: Row[Any]) -> PushEntryRecord:
    marks = {key: row._mapping[f"mark_{key}"] for key in MARKS}  # noqa: SLF001 - SQLAlchemy's public name
    doc = {key: int(value) if key.endswith("crc") else str(value) for key, value in marks.items() if value is not None}
    return replace(MARK.read(row), doc=doc)


PUSH_ENTRY = RecordMapping(PushEntryRecord, push_entries)
MARK = RecordMapping(PushEntryRecord, push_entries, doc=null())


class PushStore(StoreBase):
    """Journals of pushes, one chain for each control, named as the machine was that pushed first."""

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
            return new_id(connection, insert(push_entries).values(PUSH_ENTRY.values(entry, "id")))

        return self._write(work)

    def push_chain(self, machine: str, control: str = "") -> str:
        """Name of the journal of a control, under which its entries stand: that of the first machine that pushed into it.

        Parameters
        ----------
        machine : str
            Name of the machine.
        control : str
            Identity of its control. Empty: not known, the journal is that which this name was last used in.
        """
        doc = push_entries.c.doc
        query = (
            select(push_entries.c.machine, doc["machine"].as_string(), doc["control"].as_string())
            .where(push_entries.c.seq == 0)
            .order_by(push_entries.c.id.desc())
        )
        rows = self._read(lambda connection: connection.execute(query).all())
        return chain_of([(str(chain), str(name or chain), str(at or "")) for chain, name, at in rows], machine, control)

    def push_marks(self) -> list[PushEntryRecord]:
        """Read what the journals of all machines say of tables, in the order of writing; documents hold `MARKS` only, no images."""
        marks = [push_entries.c.doc[key].as_string().label(f"mark_{key}") for key in MARKS]
        query = select(*MARK.columns, *marks).order_by(push_entries.c.id)
        return [_mark(row) for row in self._read(lambda connection: connection.execute(query).all())]

    def push_entries(self, machine: str, control: str = "") -> list[PushEntryRecord]:
        """Read the journal of all pushes of a machine's control from its beginning (`push_chain`)."""
        return self.push_entries_of(self.push_chain(machine, control))

    def push_entries_of(self, chain: str) -> list[PushEntryRecord]:
        """Read a journal by its own name."""
        query = PUSH_ENTRY.select().where(push_entries.c.machine == chain).order_by(push_entries.c.id)
        return [PUSH_ENTRY.read(row) for row in self._read(lambda connection: connection.execute(query).all())]

    def last_push(self, machine: str, control: str = "") -> list[PushEntryRecord]:
        """Read the journal of the last push of a machine's control (`push_chain`); empty if there was none."""
        chain = self.push_chain(machine, control)
        latest = select(func.max(push_entries.c.push)).where(push_entries.c.machine == chain).scalar_subquery()
        query = PUSH_ENTRY.select().where(push_entries.c.machine == chain, push_entries.c.push == latest).order_by(push_entries.c.id)
        return [PUSH_ENTRY.read(row) for row in self._read(lambda connection: connection.execute(query).all())]
