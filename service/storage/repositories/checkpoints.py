"""Store methods for the journal of a campaign that is being measured: only ever appended, one line for everything that cannot be undone."""

from __future__ import annotations

from sqlalchemy import Connection, func, insert, select

from abbe.service.domain.document import Doc
from abbe.service.domain.measured import CheckpointRecord
from abbe.service.storage.base import StoreBase
from abbe.service.storage.repositories.campaigns import new_id
from abbe.service.storage.tables import checkpoints


class CheckpointStore(StoreBase):
    """Checkpoints of campaigns."""

    def add_checkpoint(self, campaign_id: int, kind: str, doc: Doc) -> int:
        """Append a line to a campaign's journal. On return it is on disk.

        Parameters
        ----------
        campaign_id : int
            Campaign.
        kind : str
            What happened (abbe.service.sequences.journal lists them).
        doc : dict
            What is known of it.

        Returns
        -------
        int
            Its number in the campaign, from 0.

        Raises
        ------
        StoreError
            It cannot be written.
        """

        def work(connection: Connection) -> int:
            last = connection.execute(select(func.max(checkpoints.c.seq)).where(checkpoints.c.campaign_id == campaign_id)).scalar()
            seq = 0 if last is None else int(last) + 1
            values = {"campaign_id": campaign_id, "seq": seq, "kind": kind, "doc": doc, "utc": self._now()}
            new_id(connection, insert(checkpoints).values(values))
            return seq

        return self._write(work)

    def checkpoints(self, campaign_id: int) -> list[CheckpointRecord]:
        """Read a campaign's journal from its beginning."""
        query = select(checkpoints).where(checkpoints.c.campaign_id == campaign_id).order_by(checkpoints.c.seq)
        return [CheckpointRecord(*row) for row in self._read(lambda connection: connection.execute(query).all())]
