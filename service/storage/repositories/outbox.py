"""Messages for the broker, kept until it has them."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence

from sqlalchemy import Connection, delete, func, select, update

from abbe.service.domain.document import Doc
from abbe.service.domain.service_records import OutboxRecord
from abbe.service.storage.mapping import OUTBOX
from abbe.service.storage.repository import Repository, insert_row
from abbe.service.storage.tables import outbox


class Outbox(Repository):
    """Messages for the broker."""

    def add(self, topic: str, payload: bytes | str) -> int:
        """Put a message into the outbox; it stays until it is sent. Text is stored as UTF-8."""
        data = payload.encode() if isinstance(payload, str) else payload
        return self._add(outbox, topic=topic, payload=data, created_utc=self._db.now())

    def add_document(self, topic: str, doc: Doc) -> None:
        """Put a JSON message into the outbox."""
        self._db.commit(lambda connection: queue_message(connection, topic, doc, self._db.now()))

    def count(self) -> int:
        """How many messages wait for the broker."""
        query = select(func.count()).select_from(outbox).where(outbox.c.sent_utc.is_(None))
        return int(self._db.read(lambda connection: connection.execute(query).scalar_one()))

    def pending(self, limit: int = 100) -> list[OutboxRecord]:
        """List messages that were not sent yet, in the order in which they were added."""
        return self._all(OUTBOX, outbox.c.sent_utc.is_(None), limit=limit)

    def done(self, message_id: int) -> None:
        """Note that the broker has a message; noting it again changes nothing."""
        statement = update(outbox).where(outbox.c.id == message_id, outbox.c.sent_utc.is_(None)).values(sent_utc=self._db.now())
        self._db.commit(lambda connection: connection.execute(statement))

    def prune(self, keep: int, at_most: int = 1000) -> int:
        """Forget messages that the broker has, oldest first; return how many.

        Parameters
        ----------
        keep : int
            So many of them stay, at least one: a database that numbers by "largest so far plus one" would use a number again.
        at_most : int
            So many are forgotten in one transaction; call again while it returns as many.
        """
        sent = select(outbox.c.id).where(outbox.c.sent_utc.is_not(None))
        newest = sent.order_by(outbox.c.id.desc()).limit(max(keep, 1))
        old = sent.where(outbox.c.id < select(func.min(newest.subquery().c.id)).scalar_subquery()).order_by(outbox.c.id).limit(at_most)
        return int(self._db.commit(lambda connection: connection.execute(delete(outbox).where(outbox.c.id.in_(old))).rowcount))

    def shed(
        self, topics: Sequence[str], most: int, down_to: int, notice: Callable[[int, str, str], tuple[str, bytes]] | None = None
    ) -> int:
        """Drop the oldest waiting messages of some topics when too many wait; messages of all other topics stay, however many.

        Parameters
        ----------
        topics : sequence of str
            What may be dropped.
        most : int
            More waiting messages of these topics are too many.
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
            surplus = (*waiting, outbox.c.id < min(kept))
            span = connection.execute(select(func.min(outbox.c.created_utc), func.max(outbox.c.created_utc)).where(*surplus)).one()
            dropped = int(connection.execute(delete(outbox).where(*surplus)).rowcount)
            if notice is not None:
                topic, payload = notice(dropped, *span)
                insert_row(connection, outbox, topic=topic, payload=payload, created_utc=self._db.now())
            return dropped

        return self._db.commit(work)


def queue_message(connection: Connection, topic: str, doc: Doc, now: str) -> None:
    """Put a JSON message into the outbox within a transaction."""
    payload = json.dumps(doc, ensure_ascii=False, allow_nan=False).encode()
    insert_row(connection, outbox, topic=topic, payload=payload, created_utc=now)
