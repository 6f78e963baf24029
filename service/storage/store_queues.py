"""Store methods for what must happen at last: the outbox."""

from __future__ import annotations

from sqlalchemy import insert, select, update

from service.storage.base import StoreBase
from service.storage.records import OutboxRecord
from service.storage.store_campaigns import new_id
from service.storage.tables import outbox


class QueueStore(StoreBase):
    """Messages for the broker: none is forgotten."""

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
