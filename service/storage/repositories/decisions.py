"""Store methods for rejections of proposals, and for answers that are given once: a request that comes again does nothing again."""

from __future__ import annotations

from datetime import timedelta

from sqlalchemy import Connection, delete, insert, select, update
from sqlalchemy.exc import IntegrityError

from abbe.service.domain.decisions import ProposalRejection
from abbe.service.domain.service_records import ReplyRecord
from abbe.service.storage.base import StoreBase, utc_text
from abbe.service.storage.mapping import RecordMapping
from abbe.service.storage.repositories.campaigns import new_id
from abbe.service.storage.tables_decisions import rejections, replies

KEPT = timedelta(days=7)
"""How long an answer is kept for its key."""
ABANDONED = timedelta(minutes=1)
"""A request without an answer for so long died with its process; the key may be used again."""


REJECTION = RecordMapping(ProposalRejection, rejections)


class DecisionStore(StoreBase):
    """Decisions that come over the network."""

    def add_rejection(self, rejection: ProposalRejection) -> int:
        """Store a rejection; its ``id`` and ``utc`` are given here. Returns the id."""
        values = REJECTION.values(rejection, "id") | {"utc": self._now()}
        return self._write(lambda connection: new_id(connection, insert(rejections).values(values)))

    def rejections(self, proposal_id: int) -> list[ProposalRejection]:
        """List rejections of a proposal, oldest first."""
        query = REJECTION.select().where(rejections.c.proposal_id == proposal_id).order_by(rejections.c.id)
        return [REJECTION.read(row) for row in self._read(lambda connection: connection.execute(query).all())]

    def claim_reply(self, who: str, key: str, digest: str) -> ReplyRecord | None:
        """Take a key for a request; None: it is the caller's now, and he has to `keep_reply` or `drop_reply`. Else what is there.

        Parameters
        ----------
        who, key : str
            Whose key it is: two people may use the same text.
        digest : str
            Of the request.
        """
        mine = (replies.c.who == who, replies.c.key == key)

        def work(connection: Connection) -> ReplyRecord | None:
            now = self._utcnow()
            old = replies.c.created_utc < utc_text(now - KEPT)
            dead = replies.c.status.is_(None) & (replies.c.created_utc < utc_text(now - ABANDONED))
            connection.execute(delete(replies).where(old | dead))
            row = connection.execute(select(replies.c.digest, replies.c.status, replies.c.body).where(*mine)).first()
            if row is not None:
                return ReplyRecord(*row)
            values = {"who": who, "key": key, "digest": digest, "created_utc": utc_text(now)}
            try:
                with connection.begin_nested():
                    connection.execute(insert(replies).values(values))
            except IntegrityError:  # another process was first (PostgreSQL): it is working on it
                return ReplyRecord(digest, None, None)
            return None

        return self._write(work)

    def keep_reply(self, who: str, key: str, status: int, body: str) -> None:
        """Write down what was answered to a key that was claimed."""
        statement = update(replies).where(replies.c.who == who, replies.c.key == key).values(status=status, body=body)
        self._write(lambda connection: connection.execute(statement))

    def drop_reply(self, who: str, key: str) -> None:
        """Give back a key whose request was not worked on to its end."""
        statement = delete(replies).where(replies.c.who == who, replies.c.key == key, replies.c.status.is_(None))
        self._write(lambda connection: connection.execute(statement))
