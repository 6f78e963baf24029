"""Chunks of samples. The capture may deliver one twice: on arrival, and again from a segment after a crash."""

from __future__ import annotations

import zlib
from collections.abc import Sequence

from sqlalchemy import Connection, func, insert, select
from sqlalchemy.exc import IntegrityError

from abbe.service.domain.measured import RUNNING, ChannelRecord, ChunkRecord
from abbe.service.errors import CaptureConflict, NotStored, StoreError
from abbe.service.storage.mapping import CHUNK
from abbe.service.storage.repository import Repository, if_given
from abbe.service.storage.tables import campaigns, chunks, runs


class Chunks(Repository):
    """Samples of runs."""

    def append(  # noqa: PLR0913 - one argument for each field of a chunk
        self,
        run_id: int,
        channel: str,
        seq: int,
        n: int,
        codec: str,
        payload: bytes,
        first_host_s: float,
        last_host_s: float,
        first_device_us: int,
        last_device_us: int,
    ) -> None:
        """Add samples to a running run. On return they are on disk.

        Parameters
        ----------
        channel : str
            ``"bar"``, ``"laser"``, ...
        seq : int
            Number of the chunk in its channel, from 0.
        n : int
            Number of samples.
        codec : str
            Packing of ``payload`` (`abbe.service.runs.codec`).
        first_host_s, last_host_s : float
            Monotonic host time of the first and last arrival.
        first_device_us, last_device_us : int
            Device time of the first and last sample.

        Raises
        ------
        StoreError
            The run is closed, or the chunk exists.
        """
        chunk = ChunkRecord(
            run_id, channel, seq, n, codec, zlib.crc32(payload), payload, first_host_s, last_host_s, first_device_us, last_device_us
        )

        def work(connection: Connection) -> None:
            require_running(connection, run_id)
            insert_chunk(connection, chunk)

        self._db.commit(work)

    def ingest(self, chunks_given: Sequence[ChunkRecord]) -> int:
        """Add chunks of one running run, in any order: all of them, or after an error none. Returns the number of new ones.

        A chunk that is stored already is accepted if it is equal.

        Raises
        ------
        CaptureConflict
            The database holds a different chunk of the same run, channel and number.
        StoreError
            The run is closed or does not exist, or the database cannot take it now.
        """

        def work(connection: Connection) -> int:
            run_id = chunks_given[0].run_id
            if connection.execute(select(runs.c.status).where(runs.c.id == run_id)).scalar() != RUNNING:
                raise StoreError(f"run {run_id} is closed or does not exist: nothing can be added to it")
            stored = _stored(connection, chunks_given)
            new = [one for one in chunks_given if not _is_stored(stored, one)]
            if new:
                connection.execute(insert(chunks), [CHUNK.values(one) for one in new])
            return len(new)

        if not chunks_given:
            return 0
        try:
            return self._db.commit(work)
        except StoreError as error:
            if not isinstance(error.__cause__, IntegrityError):
                raise
            return self._db.commit(work)  # another process inserted the same chunk after our look (PostgreSQL): look again

    def of_run(self, run_id: int, channel: str | None = None) -> list[ChunkRecord]:
        """Read a run's samples (of one channel), in order of channel and seq, and check their CRC.

        Raises
        ------
        StoreError
            The stored bytes have changed; names run and chunk.
        """
        query = (
            CHUNK.select().where(chunks.c.run_id == run_id, *if_given(chunks.c.channel, channel)).order_by(chunks.c.channel, chunks.c.seq)
        )
        found = [CHUNK.read(row) for row in self._db.read(lambda connection: connection.execute(query).all())]
        for chunk in found:
            if zlib.crc32(chunk.payload) != chunk.crc32:
                raise StoreError(
                    f"run {self._name(run_id)}, chunk {chunk.seq} of channel {chunk.channel!r}: stored bytes do not match their CRC",
                    "the disk or the file is damaged: restore a backup",
                )
        return found

    def between(self, run_id: int, channel: str, first: int, last: int) -> list[ChunkRecord]:
        """Chunks ``first`` to ``last`` of a channel, with their payloads, in order."""
        where = (chunks.c.run_id == run_id, chunks.c.channel == channel, chunks.c.seq.between(first, last))
        return self._all(CHUNK, *where, order=chunks.c.seq)

    def crcs(self, run_id: int) -> dict[tuple[str, int], int]:
        """CRC of every chunk of a run by channel and number, without reading payloads."""
        query = select(chunks.c.channel, chunks.c.seq, chunks.c.crc32).where(chunks.c.run_id == run_id)
        return {(row.channel, row.seq): row.crc32 for row in self._db.read(lambda connection: connection.execute(query).all())}

    def channels(self, run_id: int) -> list[ChannelRecord]:
        """List the channels of a run with the numbers of their chunks and samples."""
        columns = (chunks.c.channel, func.min(chunks.c.codec), func.count(), func.sum(chunks.c.n))
        query = select(*columns).where(chunks.c.run_id == run_id).group_by(chunks.c.channel).order_by(chunks.c.channel)
        rows = self._db.read(lambda connection: connection.execute(query).all())
        return [ChannelRecord(channel, codec, int(count), int(n)) for channel, codec, count, n in rows]

    def sizes(self, run_id: int, channel: str) -> list[tuple[int, int]]:
        """Number and sample count of every chunk of a channel, in order, without reading payloads."""
        query = select(chunks.c.seq, chunks.c.n).where(chunks.c.run_id == run_id, chunks.c.channel == channel).order_by(chunks.c.seq)
        return [(int(seq), int(n)) for seq, n in self._db.read(lambda connection: connection.execute(query).all())]

    def _name(self, run_id: int) -> str:
        query = select(campaigns.c.name + "/" + runs.c.label).select_from(runs.join(campaigns)).where(runs.c.id == run_id)
        return str(self._db.read(lambda connection: connection.execute(query).scalar()))


def insert_chunk(connection: Connection, chunk: ChunkRecord) -> None:
    """Insert a new chunk. Raises StoreError if it exists."""
    try:
        connection.execute(insert(chunks).values(CHUNK.values(chunk)))
    except IntegrityError:
        raise StoreError(f"run {chunk.run_id}: chunk {chunk.seq} of channel {chunk.channel!r} exists and is never overwritten") from None


def require_running(connection: Connection, run_id: int) -> None:
    """Raise NotStored or StoreError unless samples may be added to a run."""
    status = connection.execute(select(runs.c.status).where(runs.c.id == run_id)).scalar()
    if status is None:
        raise NotStored(f"no run {run_id} in the database")
    if status != RUNNING:
        raise StoreError(f"run {run_id} is closed ({status}): nothing can be added to it")


def _stored(connection: Connection, wanted: Sequence[ChunkRecord]) -> dict[tuple[str, int], ChunkRecord]:
    """Stored chunks in the ranges of the wanted ones, by channel and number."""
    found: dict[tuple[str, int], ChunkRecord] = {}
    for channel in {one.channel for one in wanted}:
        numbers = [one.seq for one in wanted if one.channel == channel]
        query = CHUNK.select().where(
            chunks.c.run_id == wanted[0].run_id, chunks.c.channel == channel, chunks.c.seq.between(min(numbers), max(numbers))
        )
        found |= {(channel, one.seq): one for one in map(CHUNK.read, connection.execute(query))}
    return found


def _is_stored(stored: dict[tuple[str, int], ChunkRecord], one: ChunkRecord) -> bool:
    known = stored.get((one.channel, one.seq))
    if known is not None and known != one:
        raise CaptureConflict(
            f"run {one.run_id}: chunk {one.seq} of channel {one.channel!r} is in the database with other content",
            "nothing was overwritten: compare the segment with the database",
        )
    return known is not None
