"""Measurements: machines, their campaigns, the runs with their chunks of samples, and the journal of a running campaign.

The capture may deliver a chunk twice: on arrival, and again after a crash from a segment (a file of samples on disk). The journal is
append-only, with one entry for everything that cannot be undone.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from types import MappingProxyType

from sqlalchemy import Connection, func, insert, select, update
from sqlalchemy.exc import IntegrityError

from abbe.service.domain.document import Doc
from abbe.service.domain.measured import (
    FINISHED,
    RUNNING,
    CampaignRecord,
    ChannelRecord,
    CheckpointRecord,
    ChunkRecord,
    ImportedRun,
    MachineRecord,
    RunRecord,
    this_process,
)
from abbe.service.errors import CaptureConflict, NotStored, StoreError
from abbe.service.storage.database import CAMPAIGN, CHECKPOINT, CHUNK, MACHINE, RUN, Repository, if_given, insert_row, owner_of
from abbe.service.storage.repositories.results import insert_missing_tables
from abbe.service.storage.tables import campaigns, checkpoints, chunks, heartbeats, machines, runs

MOST_DIGITS = 10
"""A text with this many digits or more is not a row id."""


class Machines(Repository):
    """Descriptions of machines."""

    def add(self, name: str, doc: Doc) -> int:
        """Store a description (``machine`` of the exchange format) and return its id. One that is stored already keeps its id."""
        return self._db.commit(lambda connection: machine_id_of(connection, name, doc, self._db.now()))

    def get(self, machine_id: int) -> MachineRecord:
        """Read one description. Raises NotStored."""
        return self._get(MACHINE, machine_id, "machine")

    def all(self) -> list[MachineRecord]:
        """List all descriptions, oldest first."""
        return self._all(MACHINE)

    def names(self) -> list[str]:
        """Names of all machines in this database, each once."""
        query = select(machines.c.name).union(select(heartbeats.c.machine))
        return sorted(str(name) for name in self._db.read(lambda connection: connection.scalars(query).all()))


class Campaigns(Repository):
    """Campaigns on machines."""

    def add(self, machine_id: int, name: str, doc: Doc) -> int:
        """Open a campaign; return its id. ``doc``: ``current_model``, ``instruments``, ... of the exchange format.

        Raises
        ------
        StoreError
            The name is taken in this database.
        """
        return self._db.commit(lambda connection: insert_campaign(connection, machine_id, name, doc, self._db.now()))

    def find(self, name_or_id: str | int) -> CampaignRecord:
        """Find a campaign by its name, or else by its id (also as text). Raises NotStored."""
        text = str(name_or_id)
        wanted = [campaigns.c.name == name_or_id] if isinstance(name_or_id, str) else []
        wanted += [campaigns.c.id == int(text)] if text.isdecimal() and len(text) < MOST_DIGITS else []
        for condition in wanted:
            if found := self._first(CAMPAIGN, condition):
                return found
        raise NotStored(f"no campaign {name_or_id!r} in {self._db.url}", "`abbe runs` lists what there is")

    def all(self) -> list[CampaignRecord]:
        """List all campaigns, oldest first."""
        return self._all(CAMPAIGN)

    def matching(self, pattern: str) -> list[str]:
        """List the names that match a pattern (``june-*``), oldest first."""
        return [one.name for one in self.all() if fnmatchcase(one.name, pattern)]


def machine_id_of(connection: Connection, name: str, doc: Doc, now: str) -> int:
    """Find or store a description. Its fingerprint does not depend on the order of its keys."""
    key = hashlib.sha256(json.dumps(doc, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
    found = connection.execute(select(machines.c.id).where(machines.c.name == name, machines.c.doc_hash == key)).scalar()
    return int(found) if found is not None else insert_row(connection, machines, name=name, doc=doc, doc_hash=key, created_utc=now)


def insert_campaign(connection: Connection, machine_id: int, name: str, doc: Doc, now: str) -> int:
    """Store a campaign whose name is not taken."""
    if connection.execute(select(campaigns.c.id).where(campaigns.c.name == name)).first() is not None:
        raise StoreError(f"campaign {name!r} is in the database already", "rename it, or use another database (--db)")
    return insert_row(connection, campaigns, machine_id=machine_id, name=name, doc=doc, created_utc=now)


class Runs(Repository):
    """Runs of campaigns."""

    def start(self, campaign_id: int, label: str, test: str, role: str, doc: Doc) -> int:
        """Begin a run, owned by this process until it is finished; return its id.

        Parameters
        ----------
        label : str
            ``run_id`` of the exchange format, unique in the campaign, e.g. ``"r01"``.
        test, role : str
            As in the exchange format.
        doc : dict
            Start document (`abbe.service.runs.columns`).

        Raises
        ------
        StoreError
            The label is taken.
        """
        values = {"campaign_id": campaign_id, "label": label, "test": test, "role": role, "status": RUNNING, "reason": "", "start_doc": doc}
        return self._db.commit(lambda connection: _insert_run(connection, values | {"started_utc": self._db.now()}))

    def finish(self, run_id: int, status: str, reason: str, doc: Doc | None) -> None:
        """Close a run; it cannot be opened again.

        Parameters
        ----------
        status : str
            One of `abbe.service.domain.measured.FINISHED`.
        reason : str
            A sentence; empty for a complete run.
        doc : dict or None
            End document; None if the end was not reached.

        Raises
        ------
        StoreError
            There is no such run, or it is already closed.
        """
        if status not in FINISHED:
            raise StoreError(f"run status {status!r} is not one of {', '.join(FINISHED)}")
        values = {"status": status, "reason": reason, "end_doc": doc, "ended_utc": self._db.now()}

        def work(connection: Connection) -> None:
            done = connection.execute(update(runs).where(runs.c.id == run_id, runs.c.status == RUNNING).values(values))
            if done.rowcount != 1:
                require_running(connection, run_id)

        self._db.commit(work)

    def import_campaign(
        self,
        machine: tuple[str, Doc],
        campaign: tuple[str, Doc],
        imported: Sequence[ImportedRun],
        tables: Mapping[int, bytes] = MappingProxyType({}),
    ) -> int:
        """Store a campaign that was measured elsewhere; return its id. After an error nothing is stored.

        Parameters
        ----------
        machine, campaign : tuple of str and dict
            Name and document.
        imported : sequence of ImportedRun
            The runs; each gets one chunk in channel ``"columns"``.
        tables : mapping of int to bytes
            Images of the compensation tables that acted during the runs, by CRC; those that the machine has already are not stored twice.

        Raises
        ------
        StoreError
            There is a campaign of this name.
        """

        def work(connection: Connection) -> int:
            now = self._db.now()
            machine_id = machine_id_of(connection, *machine, now)
            campaign_id = insert_campaign(connection, machine_id, *campaign, now)
            for run in imported:
                _insert_imported(connection, campaign_id, run, now)
            insert_missing_tables(connection, machine_id, tables, now)
            return campaign_id

        return self._db.commit(work)

    def all(self, campaign: str | int | None = None) -> list[RunRecord]:
        """List runs (of one campaign, by name or id) in order of their start. Raises NotStored."""
        campaign_id = None if campaign is None else Campaigns(self._db).find(campaign).id
        return self._all(RUN, *if_given(runs.c.campaign_id, campaign_id))

    def latest(self, limit: int, *, campaign: str = "", test: str = "", status: str = "") -> list[RunRecord]:
        """List the newest runs, newest first, of a campaign, test and stored status; empty: any."""
        conditions = (
            *if_given(campaigns.c.name, campaign or None),
            *if_given(runs.c.test, test or None),
            *if_given(runs.c.status, status or None),
        )
        return self._all(RUN, *conditions, newest=True, limit=limit)

    def find(self, id_or_label: int | str) -> RunRecord:
        """Find a run by its label (``"r01"``, or ``"campaign/r01"`` where several campaigns use it), or by its id (also as text).

        Raises
        ------
        NotStored
            There is no such run.
        StoreError
            Several runs match.
        """
        text = str(id_or_label)
        named = (runs.c.label == text) | (campaigns.c.name + "/" + runs.c.label == text)
        found = self._all(RUN, named) if isinstance(id_or_label, str) else []
        if not found and text.isdecimal():
            found = self._all(RUN, runs.c.id == int(text))
        if not found:
            raise NotStored(f"no run {text!r} in {self._db.url}", "`abbe runs` lists what there is")
        if len(found) > 1:
            names = ", ".join(f"{one.campaign}/{one.label}" for one in found)
            raise StoreError(f"run {text!r} exists more than once", f"write one of {names}")
        return found[0]

    def numbered(self, run_id: int) -> RunRecord | None:
        """The run of an id, None if there is none."""
        return self._first(RUN, runs.c.id == run_id)


def _insert_run(connection: Connection, values: Doc) -> int:
    taken = select(runs.c.id).where(runs.c.campaign_id == values["campaign_id"], runs.c.label == values["label"])
    if connection.execute(taken).first() is not None:
        raise StoreError(f"run {values['label']!r} exists already in this campaign", "give it another label")
    return insert_row(connection, runs, **values, **owner_of(runs).values(this_process()))


def _insert_imported(connection: Connection, campaign_id: int, run: ImportedRun, now: str) -> None:
    """Store a run that was measured elsewhere; it is closed from the start."""
    values = {"campaign_id": campaign_id, "label": run.label, "test": run.test, "role": run.role, "start_doc": run.start_doc}
    run_id = _insert_run(connection, values | {"status": "complete", "reason": "imported", "started_utc": now, "ended_utc": now})
    insert_chunk(connection, ChunkRecord(run_id, "columns", 0, run.n, run.codec, zlib.crc32(run.payload), run.payload, 0.0, 0.0, 0, 0))


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
            Packing of ``payload`` (`abbe.service.runs.chunks`).
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
        """Add chunks of one running run, in any order; return the number of new ones. After an error none is added.

        A chunk that is stored already is accepted if it has the same content.

        Raises
        ------
        CaptureConflict
            The database holds a different chunk of the same run, channel and number.
        StoreError
            The run is closed or does not exist, or the database cannot be written now.
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
            return self._db.commit(work)  # another process inserted the same chunk after our SELECT (PostgreSQL): try again

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
        found = self._db.read(lambda connection: [CHUNK.read(row) for row in connection.execute(query)])
        for chunk in found:
            if zlib.crc32(chunk.payload) != chunk.crc32:
                raise StoreError(
                    f"run {self._name(run_id)}, chunk {chunk.seq} of channel {chunk.channel!r}: stored bytes do not match their CRC",
                    "the disk or the file is damaged: restore a backup",
                )
        return found

    def between(self, run_id: int, channel: str, first: int, last: int) -> list[ChunkRecord]:
        """Chunks ``first`` to ``last`` of a channel, with their payloads, in order."""
        conditions = (chunks.c.run_id == run_id, chunks.c.channel == channel, chunks.c.seq.between(first, last))
        return self._all(CHUNK, *conditions, order=chunks.c.seq)

    def crcs(self, run_id: int) -> dict[tuple[str, int], int]:
        """CRC of every chunk of a run by channel and number, without reading payloads."""
        query = select(chunks.c.channel, chunks.c.seq, chunks.c.crc32).where(chunks.c.run_id == run_id)
        return {(row.channel, row.seq): row.crc32 for row in self._db.read(lambda connection: connection.execute(query).all())}

    def channels(self, run_id: int) -> list[ChannelRecord]:
        """List the channels of a run. Each says how many chunks and samples it has."""
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
    """Return the stored chunks in the ranges of the wanted chunks, by channel and number."""
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
