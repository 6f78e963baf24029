"""Journal of a running campaign: append-only, one entry for everything that cannot be undone."""

from __future__ import annotations

from sqlalchemy import Connection, func, select

from abbe.service.domain.document import Doc
from abbe.service.domain.measured import CheckpointRecord
from abbe.service.storage.mapping import CHECKPOINT
from abbe.service.storage.repository import Repository, insert_row
from abbe.service.storage.tables import checkpoints


class Checkpoints(Repository):
    """Checkpoints of campaigns."""

    def add(self, campaign_id: int, kind: str, doc: Doc) -> int:
        """Append an entry to a campaign's journal; on return it is on disk. Returns its number in the campaign, from 0.

        ``kind``: one of those in `abbe.service.sequences.journal`. Raises StoreError.
        """

        def work(connection: Connection) -> int:
            last = connection.execute(select(func.max(checkpoints.c.seq)).where(checkpoints.c.campaign_id == campaign_id)).scalar()
            seq = 0 if last is None else int(last) + 1
            insert_row(connection, checkpoints, campaign_id=campaign_id, seq=seq, kind=kind, doc=doc, utc=self._db.now())
            return seq

        return self._db.commit(work)

    def of_campaign(self, campaign_id: int) -> list[CheckpointRecord]:
        """Read a campaign's journal from its beginning."""
        return self._all(CHECKPOINT, checkpoints.c.campaign_id == campaign_id, order=checkpoints.c.seq)
