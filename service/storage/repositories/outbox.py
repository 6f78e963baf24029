"""Messages for the broker, stored until the broker has them."""

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
        """List unsent messages in the order in which they were added."""
        return self._all(OUTBOX, outbox.c.sent_utc.is_(None), limit=limit)

    def done(self, message_id: int) -> None:
        """Mark a message as sent; a second call changes nothing."""
        statement = update(outbox).where(outbox.c.id == message_id, outbox.c.sent_utc.is_(None)).values(sent_utc=self._db.now())
        self._db.commit(lambda connection: connection.execute(statement))

    def prune(self, keep: int, at_most: int = 1000) -> int:
        """Delete sent messages, oldest first; return how many.

        The newest ``keep`` stay, at least one: a database that numbers by "largest id plus one" would reuse an id. At most ``at_most`` are
        deleted in one transaction; call again while it returns that number.
        """
        sent = select(outbox.c.id).where(outbox.c.sent_utc.is_not(None))
        newest = sent.order_by(outbox.c.id.desc()).limit(max(keep, 1))
        old = sent.where(outbox.c.id < select(func.min(newest.subquery().c.id)).scalar_subquery()).order_by(outbox.c.id).limit(at_most)
        return int(self._db.commit(lambda connection: connection.execute(delete(outbox).where(outbox.c.id.in_(old))).rowcount))

    def shed(
        self, topics: Sequence[str], most: int, down_to: int, notice: Callable[[int, str, str], tuple[str, bytes]] | None = None
    ) -> int:
        """Drop the oldest waiting messages of some topics if more than ``most`` wait; return how many. Other topics are untouched.

        Parameters
        ----------
        topics : sequence of str
            Topics whose messages may be dropped.
        down_to : int
            Number of the newest messages that stay; at least one.
        notice : callable, optional
            Makes topic and payload of a message about the loss, from the number of dropped messages and the times of the oldest and the
            newest. It is queued in the same transaction: no loss is silent.
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
