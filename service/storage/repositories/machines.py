"""Machines and campaigns: what measurements belong to."""

from __future__ import annotations

import hashlib
import json

from sqlalchemy import Connection, select

from abbe.service.domain.document import Doc
from abbe.service.domain.measured import CampaignRecord, MachineRecord
from abbe.service.errors import NotStored, StoreError
from abbe.service.storage.mapping import CAMPAIGN, MACHINE
from abbe.service.storage.repository import Repository, insert_row
from abbe.service.storage.tables import campaigns, heartbeats, machines

MOST_DIGITS = 10
"""A text with this many digits or more is no row id."""


class Machines(Repository):
    """Descriptions of machines."""

    def add(self, name: str, doc: Doc) -> int:
        """Store a description (``machine`` of the exchange format) once: the same name and description give the same id."""
        return self._db.commit(lambda connection: machine_id_of(connection, name, doc, self._db.now()))

    def get(self, machine_id: int) -> MachineRecord:
        """Read one description. Raises NotStored."""
        return self._get(MACHINE, machine_id, "machine")

    def all(self) -> list[MachineRecord]:
        """List all descriptions, oldest first."""
        return self._all(MACHINE)

    def names(self) -> list[str]:
        """Names of all machines in this database, each once."""
        query = select(machines.c.name).union(select(heartbeats.c.machine))
        return sorted(str(name) for name in self._db.read(lambda connection: connection.scalars(query).all()))


class Campaigns(Repository):
    """Campaigns on machines."""

    def add(self, machine_id: int, name: str, doc: Doc) -> int:
        """Open a campaign; return its id. ``doc``: ``current_model``, ``instruments``, ... of the exchange format.

        Raises
        ------
        StoreError
            The name is taken in this database.
        """
        return self._db.commit(lambda connection: insert_campaign(connection, machine_id, name, doc, self._db.now()))

    def find(self, name_or_id: str | int) -> CampaignRecord:
        """Find a campaign by its name, or else by its id (also as text). Raises NotStored."""
        text = str(name_or_id)
        wanted = [campaigns.c.name == name_or_id] if isinstance(name_or_id, str) else []
        wanted += [campaigns.c.id == int(text)] if text.isdecimal() and len(text) < MOST_DIGITS else []
        for condition in wanted:
            if found := self._first(CAMPAIGN, condition):
                return found
        raise NotStored(f"no campaign {name_or_id!r} in {self._db.url}", "`abbe runs` lists what there is")

    def all(self) -> list[CampaignRecord]:
        """List all campaigns, oldest first."""
        return self._all(CAMPAIGN)


def machine_id_of(connection: Connection, name: str, doc: Doc, now: str) -> int:
    """Find or store a description. Its fingerprint does not depend on the order of its keys."""
    key = hashlib.sha256(json.dumps(doc, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
    found = connection.execute(select(machines.c.id).where(machines.c.name == name, machines.c.doc_hash == key)).scalar()
    return int(found) if found is not None else insert_row(connection, machines, name=name, doc=doc, doc_hash=key, created_utc=now)


def insert_campaign(connection: Connection, machine_id: int, name: str, doc: Doc, now: str) -> int:
    """Store a campaign whose name is not taken."""
    if connection.execute(select(campaigns.c.id).where(campaigns.c.name == name)).first() is not None:
        raise StoreError(f"campaign {name!r} is in the database already", "rename it, or use another database (--db)")
    return insert_row(connection, campaigns, machine_id=machine_id, name=name, doc=doc, created_utc=now)
