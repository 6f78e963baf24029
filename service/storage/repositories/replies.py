"""Idempotency: a repeated request with the same key gets the stored answer and does nothing."""

from __future__ import annotations

from datetime import timedelta

from sqlalchemy import Connection, delete, update
from sqlalchemy.exc import IntegrityError

from abbe.service.domain.service_records import ReplyRecord
from abbe.service.domain.utc import utc_text
from abbe.service.storage.mapping import REPLY
from abbe.service.storage.repository import Repository, insert_row
from abbe.service.storage.tables import replies

KEPT = timedelta(days=7)
"""How long an answer is stored."""
ABANDONED = timedelta(minutes=1)
"""A request without an answer for this long has died with its process; its key is free again."""


class Replies(Repository):
    """Answers by idempotency key. Each key belongs to ``who`` sent it: two people may use the same text."""

    def claim(self, who: str, key: str, digest: str) -> ReplyRecord | None:
        """Claim a key for a request of this digest. None: the caller has it and must `keep` or `drop` it; otherwise the stored reply."""

        def work(connection: Connection) -> ReplyRecord | None:
            now = self._db.utcnow()
            old = replies.c.created_utc < utc_text(now - KEPT)
            dead = replies.c.status.is_(None) & (replies.c.created_utc < utc_text(now - ABANDONED))
            connection.execute(delete(replies).where(old | dead))
            row = connection.execute(REPLY.select().where(replies.c.who == who, replies.c.key == key)).first()
            if row is not None:
                return REPLY.read(row)
            try:
                with connection.begin_nested():
                    insert_row(connection, replies, who=who, key=key, digest=digest, created_utc=utc_text(now))
            except IntegrityError:  # another process was first (PostgreSQL) and is working on the request
                return ReplyRecord(digest, None, None)
            return None

        return self._db.commit(work)

    def keep(self, who: str, key: str, status: int, body: str) -> None:
        """Store the answer to the request of a claimed key."""
        statement = update(replies).where(replies.c.who == who, replies.c.key == key).values(status=status, body=body)
        self._db.commit(lambda connection: connection.execute(statement))

    def drop(self, who: str, key: str) -> None:
        """Release a key whose request was not completed."""
        statement = delete(replies).where(replies.c.who == who, replies.c.key == key, replies.c.status.is_(None))
        self._db.commit(lambda connection: connection.execute(statement))
