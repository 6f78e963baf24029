"""Store method for chunks that may come twice: from the capture, and again from a segment after a crash."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import Connection, insert, select
from sqlalchemy.exc import IntegrityError

from abbe.service.domain.measured import RUNNING, ChunkRecord
from abbe.service.errors import CaptureConflict, StoreError
from abbe.service.storage.repositories.campaigns import CampaignStore
from abbe.service.storage.tables import chunks, runs

_FIELDS = tuple(ChunkRecord.__dataclass_fields__)


class ChunkStore(CampaignStore):
    """Idempotent ingest."""

    def ingest_chunks(self, given: Sequence[ChunkRecord]) -> int:
        """Add chunks of one running run; one that is there already is accepted when it is equal. All of them, or after an error none.

        Parameters
        ----------
        given : sequence of ChunkRecord
            In any order.

        Returns
        -------
        int
            How many were new.

        Raises
        ------
        CaptureConflict
            The database holds another chunk under the same run, channel and number.
        StoreError
            The run is closed or does not exist, or the database does not take it now.
        """

        def work(connection: Connection) -> int:
            if connection.execute(select(runs.c.status).where(runs.c.id == given[0].run_id)).scalar() != RUNNING:
                raise StoreError(f"run {given[0].run_id} is closed or does not exist: nothing can be added to it")
            present = _present(connection, given)
            new = [one for one in given if not _is_there(present, one)]
            if new:
                connection.execute(insert(chunks), [{name: getattr(one, name) for name in _FIELDS} for one in new])
            return len(new)

        if not given:
            return 0
        try:
            return self._write(work)
        except StoreError as error:
            if not isinstance(error.__cause__, IntegrityError):
                raise
            return self._write(work)  # somebody put the same in between our look and our insert (PostgreSQL): look again

    def chunk_keys(self, run_id: int) -> dict[tuple[str, int], int]:
        """CRC of every chunk of a run by channel and number; payloads are not read."""
        query = select(chunks.c.channel, chunks.c.seq, chunks.c.crc32).where(chunks.c.run_id == run_id)
        return {(channel, seq): crc for channel, seq, crc in self._read(lambda connection: connection.execute(query).all())}


def _present(connection: Connection, given: Sequence[ChunkRecord]) -> dict[tuple[str, int], ChunkRecord]:
    found: dict[tuple[str, int], ChunkRecord] = {}
    for channel in {one.channel for one in given}:
        numbers = [one.seq for one in given if one.channel == channel]
        columns = [chunks.c[name] for name in _FIELDS]
        query = select(*columns).where(
            chunks.c.run_id == given[0].run_id, chunks.c.channel == channel, chunks.c.seq.between(min(numbers), max(numbers))
        )
        found |= {(channel, row.seq): ChunkRecord(*row) for row in connection.execute(query)}
    return found


def _is_there(present: dict[tuple[str, int], ChunkRecord], one: ChunkRecord) -> bool:
    known = present.get((one.channel, one.seq))
    if known is not None and known != one:
        raise CaptureConflict(
            f"run {one.run_id}: chunk {one.seq} of channel {one.channel!r} is in the database with other content",
            "nothing was overwritten: compare the segment with the database",
        )
    return known is not None
