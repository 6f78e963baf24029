"""Store methods for machines and campaigns: to what the measurements belong."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from sqlalchemy import Connection, Insert, Select, insert, select

from abbe.service.domain.document import Doc
from abbe.service.domain.measured import CampaignRecord, MachineRecord
from abbe.service.errors import NotStored, StoreError
from abbe.service.storage.base import StoreBase
from abbe.service.storage.tables import campaigns, machines

MOST_DIGITS = 10
"""A number with more is no number of a row."""


def doc_hash(doc: Doc) -> str:
    """Fingerprint a document independently of the order of its keys.

    Parameters
    ----------
    doc : dict
        JSON object.

    Returns
    -------
    str
        SHA-256, hexadecimal.
    """
    return hashlib.sha256(json.dumps(doc, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


class CampaignStore(StoreBase):
    """Machines, and campaigns on them."""

    def add_machine(self, name: str, doc: Doc) -> int:
        """Store a machine's description, once: the same name and description give the same id.

        Parameters
        ----------
        name : str
            Name of the machine.
        doc : dict
            ``machine`` object of the exchange format.

        Returns
        -------
        int
            Id.
        """
        return self._write(lambda connection: machine_id_of(connection, name, doc, self._now()))

    def machine(self, machine_id: int) -> MachineRecord:
        """Read one machine.

        Parameters
        ----------
        machine_id : int
            Id.

        Returns
        -------
        MachineRecord
            The record.

        Raises
        ------
        NotStored
            If there is none.
        """
        found = self._read(lambda connection: connection.execute(select(machines).where(machines.c.id == machine_id)).first())
        if found is None:
            raise NotStored(f"no machine {machine_id} in {self.url}")
        return MachineRecord(*found)

    def machines(self) -> list[MachineRecord]:
        """List all machines, oldest description first.

        Returns
        -------
        list of MachineRecord
            The records.
        """
        return [
            MachineRecord(*row) for row in self._read(lambda connection: connection.execute(select(machines).order_by(machines.c.id)).all())
        ]

    def add_campaign(self, machine_id: int, name: str, doc: Doc) -> int:
        """Open a campaign.

        Parameters
        ----------
        machine_id : int
            Whose.
        name : str
            Unique in this database.
        doc : dict
            What else is known of it (``current_model``, ``instruments``, ... of the exchange format).

        Returns
        -------
        int
            Id.

        Raises
        ------
        StoreError
            If the name is taken.
        """
        return self._write(lambda connection: insert_campaign(connection, machine_id, name, doc, self._now()))

    def campaign(self, name_or_id: str | int) -> CampaignRecord:
        """Find a campaign.

        Parameters
        ----------
        name_or_id : str or int
            Its name, or its id (also as text).

        Returns
        -------
        CampaignRecord
            The record.

        Raises
        ------
        NotStored
            If there is none.
        """
        text = str(name_or_id)
        wanted = [campaigns.c.name == name_or_id] if isinstance(name_or_id, str) else []
        wanted += [campaigns.c.id == int(text)] if text.isdecimal() and len(text) < MOST_DIGITS else []
        for query in (select(campaigns).where(condition) for condition in wanted):
            if found := self._campaigns(query):
                return found[0]
        raise NotStored(f"no campaign {name_or_id!r} in {self.url}", "`abbe runs` lists what there is")

    def campaigns(self) -> list[CampaignRecord]:
        """List all campaigns, oldest first.

        Returns
        -------
        list of CampaignRecord
            The records.
        """
        return self._campaigns(select(campaigns).order_by(campaigns.c.id))

    def _campaigns(self, query: Select[tuple[Any, ...]]) -> list[CampaignRecord]:
        return [CampaignRecord(*row) for row in self._read(lambda connection: connection.execute(query).all())]


def machine_id_of(connection: Connection, name: str, doc: Doc, now: str) -> int:
    """Find or store a machine's description.

    Parameters
    ----------
    connection : Connection
        Inside a transaction.
    name : str
        Name.
    doc : dict
        Description.
    now : str
        Time for a new record.

    Returns
    -------
    int
        Id.
    """
    key = doc_hash(doc)
    found = connection.execute(select(machines.c.id).where(machines.c.name == name, machines.c.doc_hash == key)).scalar()
    return (
        int(found) if found is not None else new_id(connection, insert(machines).values(name=name, doc=doc, doc_hash=key, created_utc=now))
    )


def new_id(connection: Connection, statement: Insert) -> int:
    """Insert one row.

    Parameters
    ----------
    connection : Connection
        Inside a transaction.
    statement : Insert
        What to insert.

    Returns
    -------
    int
        Id of the new row.
    """
    key = connection.execute(statement).inserted_primary_key
    assert key is not None
    return int(key[0])


def insert_campaign(connection: Connection, machine_id: int, name: str, doc: Doc, now: str) -> int:
    """Store a new campaign.

    Parameters
    ----------
    connection : Connection
        Inside a transaction.
    machine_id : int
        Whose.
    name : str
        Name, not taken yet.
    doc : dict
        What else is known.
    now : str
        Time of the record.

    Returns
    -------
    int
        Id.

    Raises
    ------
    StoreError
        If the name is taken.
    """
    if connection.execute(select(campaigns.c.id).where(campaigns.c.name == name)).first() is not None:
        raise StoreError(f"campaign {name!r} is in the database already", "rename it, or use another database (--db)")
    return new_id(connection, insert(campaigns).values(machine_id=machine_id, name=name, doc=doc, created_utc=now))
