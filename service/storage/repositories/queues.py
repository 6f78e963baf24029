"""Store methods for what must happen at last: the outbox."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from sqlalchemy import Connection, delete, func, insert, select, update

from abbe.service.domain.service_records import OutboxRecord
from abbe.service.storage.base import StoreBase
from abbe.service.storage.repositories.campaigns import new_id
from abbe.service.storage.tables import outbox


class QueueStore(StoreBase):
    """Messages for the broker, kept until it has them."""

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

    def outbox_prune(self, keep: int, at_most: int = 1000) -> int:
        """Forget messages that the broker has, oldest first.

        Parameters
        ----------
        keep : int
            So many of them stay, at least one: a database that numbers by "largest so far plus one" would use a number again.
        at_most : int
            So many are forgotten in one transaction; call again while it returns as many.

        Returns
        -------
        int
            How many were forgotten.
        """
        sent = select(outbox.c.id).where(outbox.c.sent_utc.is_not(None))
        newest = sent.order_by(outbox.c.id.desc()).limit(max(keep, 1))
        old = sent.where(outbox.c.id < select(func.min(newest.subquery().c.id)).scalar_subquery()).order_by(outbox.c.id).limit(at_most)
        return int(self._write(lambda connection: connection.execute(delete(outbox).where(outbox.c.id.in_(old))).rowcount))

    def outbox_shed(
        self, topics: Sequence[str], most: int, down_to: int, notice: Callable[[int, str, str], tuple[str, bytes]] | None = None
    ) -> int:
        """Drop the oldest waiting messages of some topics when too many wait; messages of all other topics stay, however many.

        Parameters
        ----------
        topics : sequence of str
            What may be dropped.
        most : int
            More than so many waiting messages of these topics are too many.
        down_to : int
            So many, the newest, stay then; at least one.
        notice : callable, optional
            Given how many are dropped and when the oldest and the newest of them were made, returns topic and payload of a message that
            says so. It is queued in the same transaction: nothing is lost in silence.

        Returns
        -------
        int
            How many were dropped.
        """
        waiting = (outbox.c.sent_utc.is_(None), outbox.c.topic.in_(topics))

        def work(connection: Connection) -> int:
            count = int(connection.execute(select(func.count()).where(*waiting)).scalar_one())
            if count <= most:
                return 0
            kept = connection.execute(select(outbox.c.id).where(*waiting).order_by(outbox.c.id.desc()).limit(max(down_to, 1))).scalars()
            gone = (*waiting, outbox.c.id < min(kept))
            span = connection.execute(select(func.min(outbox.c.created_utc), func.max(outbox.c.created_utc)).where(*gone)).one()
            dropped = int(connection.execute(delete(outbox).where(*gone)).rowcount)
            if notice is not None:
                topic, payload = notice(dropped, *span)
                connection.execute(insert(outbox).values(topic=topic, payload=payload, created_utc=self._now()))
            return dropped

        return self._write(work)

    def waiting_messages(self) -> int:
        """Return how many messages wait for the broker."""
        query = select(func.count()).select_from(outbox).where(outbox.c.sent_utc.is_(None))
        return int(self._read(lambda connection: connection.execute(query).scalar_one()))
