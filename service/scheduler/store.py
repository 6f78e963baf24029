"""The store with what an unattended service adds: a result and its messages in one transaction, and questions by machine name."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import datetime

from sqlalchemy import ColumnElement, Connection, func, insert, or_, select

from abbe.service.domain.document import Doc
from abbe.service.domain.service_records import SlotRecord
from abbe.service.storage.repositories.campaigns import new_id
from abbe.service.storage.repositories.slots import SLOT_COLUMNS, slot_record
from abbe.service.storage.store import Store
from abbe.service.storage.tables import campaigns, machines, outbox, slots, verifications


class ServiceStore(Store):
    """A `Store` that is also ledger, shelf and archive of the service. Open it with ``ServiceStore.open``."""

    def keep_verification(self, machine_id: int, doc: Doc, messages: Sequence[tuple[str, Doc]]) -> int:
        """Store the result of a check together with the messages about it: both or neither survive a power cut.

        Parameters
        ----------
        machine_id : int
            The machine, for checks that failed before they had a campaign.
        doc : dict
            As made by `abbe.service.scheduler.record`.
        messages : sequence of (topic, document)
            What the broker is to be told; each is given the number of the verification.

        Returns
        -------
        int
            Number of the verification.
        """

        def work(connection: Connection) -> int:
            found = connection.execute(select(campaigns.c.id, campaigns.c.machine_id).where(campaigns.c.name == doc["campaign"])).first()
            campaign_id, of_machine = (int(found[0]), int(found[1])) if found is not None else (None, machine_id)
            values = {"machine_id": of_machine, "campaign_id": campaign_id, "verdict": doc["verdict"], "doc": doc, "utc": self._now()}
            number = new_id(connection, insert(verifications).values(values))
            for topic, message in messages:
                self._put(connection, topic, {"verification": number, **message})
            return number

        return self._write(work)

    def put_message(self, topic: str, doc: Doc) -> None:
        """Queue one message for the broker."""
        self._write(lambda connection: self._put(connection, topic, doc))

    def _put(self, connection: Connection, topic: str, doc: Doc) -> int:
        payload = json.dumps(doc, ensure_ascii=False, allow_nan=False).encode()
        return new_id(connection, insert(outbox).values(topic=topic, payload=payload, created_utc=self._now()))

    def last_slot(self, schedule: str) -> datetime | None:
        """Return the latest slot of a schedule that anybody claimed, or None."""
        # Slots are written so that text order is time order.
        query = select(func.max(slots.c.slot_utc)).where(slots.c.schedule == schedule)
        text = self._read(lambda connection: connection.execute(query).scalar())
        return None if text is None else datetime.fromisoformat(text)

    def slots_not_run(self, machine: str, limit: int = 20) -> list[SlotRecord]:
        """Return the latest slots of a machine that were missed, skipped or interrupted, newest first.

        Parameters
        ----------
        machine : str
            Name of the machine.
        limit : int
            At most so many.
        """
        states = [slots.c.state.startswith(word) for word in ("missed", "skipped", "interrupted")]
        query = select(*SLOT_COLUMNS).where(_timetable_of(machine), or_(*states))
        rows = self._read(lambda connection: connection.execute(query.order_by(slots.c.id.desc()).limit(limit)).all())
        return [slot_record(row) for row in rows]

    def verdict_counts(self, machine: str) -> dict[str, int]:
        """Return how many checks of a machine ended with each verdict, over its whole history."""
        query = select(verifications.c.verdict, func.count()).join(machines, machines.c.id == verifications.c.machine_id)
        query = query.where(machines.c.name == machine).group_by(verifications.c.verdict)
        return {str(verdict): int(count) for verdict, count in self._read(lambda connection: connection.execute(query).all())}

    def slot_counts(self, machine: str) -> dict[str, int]:
        """Return how many slots of a machine's timetables stand at each state."""
        query = select(slots.c.state, func.count()).where(_timetable_of(machine)).group_by(slots.c.state)
        return {str(state): int(count) for state, count in self._read(lambda connection: connection.execute(query).all())}


def _timetable_of(machine: str) -> ColumnElement[bool]:
    """Slots of a machine. Not by LIKE: SQLite's takes mill-7 and MILL-7 for the same machine."""
    prefix = f"{machine}/"
    return func.substr(slots.c.schedule, 1, len(prefix)) == prefix
