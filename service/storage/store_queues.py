"""Store methods for what must happen exactly once or at last: schedule slots and the outbox."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import Connection, insert, select, update
from sqlalchemy.dialects.postgresql import insert as pg_insert
from sqlalchemy.dialects.sqlite import insert as sqlite_insert

from service.errors import StoreError
from service.storage.base import StoreBase, utc_text
from service.storage.records import OutboxRecord
from service.storage.store_campaigns import new_id
from service.storage.tables import outbox, slots

CLAIMED = "claimed"


class QueueStore(StoreBase):
    """Slots of schedules (each is run by one process only) and messages for the broker (none is forgotten)."""

    def claim_slot(self, schedule: str, slot_utc: datetime | str) -> bool:
        """Take a slot of a schedule.

        Parameters
        ----------
        schedule : str
            Its name.
        slot_utc : datetime or str
            When it is due; text is ISO 8601 with time zone.

        Returns
        -------
        bool
            False if somebody has it.
        """
        values = {"schedule": schedule, "slot_utc": _slot(slot_utc), "state": CLAIMED, "claimed_utc": self._now()}

        def work(connection: Connection) -> bool:
            fresh = pg_insert(slots) if connection.dialect.name == "postgresql" else sqlite_insert(slots)
            return connection.execute(fresh.values(values).on_conflict_do_nothing().returning(slots.c.id)).first() is not None

        return self._write(work)

    def finish_slot(self, schedule: str, slot_utc: datetime | str, state: str) -> None:
        """Write how a claimed slot ended.

        Parameters
        ----------
        schedule : str
            Its name.
        slot_utc : datetime or str
            As it was claimed.
        state : str
            E.g. ``"done"``.

        Raises
        ------
        StoreError
            If nobody claimed it.
        """
        key = _slot(slot_utc)
        statement = update(slots).where(slots.c.schedule == schedule, slots.c.slot_utc == key)
        done = self._write(lambda connection: connection.execute(statement.values(state=state, finished_utc=self._now())).rowcount)
        if done != 1:
            raise StoreError(f"slot {key} of schedule {schedule!r} was not claimed")

    def outbox_add(self, topic: str, payload: bytes | str) -> int:
        """Put a message into the outbox; it stays until it is sent.

        Parameters
        ----------
        topic : str
            Topic.
        payload : bytes or str
            Text is stored as UTF-8.

        Returns
        -------
        int
            Id.
        """
        data = payload.encode() if isinstance(payload, str) else payload
        return self._write(lambda connection: new_id(connection, insert(outbox).values(topic=topic, payload=data, created_utc=self._now())))

    def outbox_pending(self, limit: int = 100) -> list[OutboxRecord]:
        """List messages that were not sent yet, in the order in which they were added.

        Parameters
        ----------
        limit : int
            At most so many.

        Returns
        -------
        list of OutboxRecord
            The messages.
        """
        query = select(outbox.c.id, outbox.c.topic, outbox.c.payload, outbox.c.created_utc).where(outbox.c.sent_utc.is_(None))
        query = query.order_by(outbox.c.id).limit(limit)
        return [OutboxRecord(*row) for row in self._read(lambda connection: connection.execute(query).all())]

    def outbox_done(self, message_id: int) -> None:
        """Note that the broker has a message; noting it again changes nothing.

        Parameters
        ----------
        message_id : int
            Id.
        """
        statement = update(outbox).where(outbox.c.id == message_id, outbox.c.sent_utc.is_(None)).values(sent_utc=self._now())
        self._write(lambda connection: connection.execute(statement).rowcount)


def _slot(moment: datetime | str) -> str:
    if isinstance(moment, datetime):
        return utc_text(moment)
    try:
        return utc_text(datetime.fromisoformat(moment))
    except ValueError:
        raise StoreError(f"slot time {moment!r} is not ISO 8601", "write e.g. 2026-11-21T03:00:00Z") from None
