"""Store methods for runs and their chunks: what was measured."""

from __future__ import annotations

import zlib

from sqlalchemy import Connection, Row, Select, insert, select, update
from sqlalchemy.exc import IntegrityError

from abbe.service.domain.document import Doc
from abbe.service.domain.measured import FINISHED, RUNNING, ChunkRecord, ImportedRun, RunRecord
from abbe.service.domain.owner import Owner, this_process
from abbe.service.errors import NotStored, StoreError
from abbe.service.storage.repositories.campaigns import new_id
from abbe.service.storage.repositories.chunks import ChunkStore
from abbe.service.storage.tables import campaigns, chunks, runs


class RunStore(ChunkStore):
    """Runs and their samples."""

    def start_run(self, campaign_id: int, label: str, test: str, role: str, doc: Doc) -> int:
        """Begin a run, owned by this process until it is finished.

        Parameters
        ----------
        campaign_id : int
            Campaign.
        label : str
            ``run_id`` of the exchange format, unique in the campaign, e.g. ``"r01"``.
        test, role : str
            As in the exchange format.
        doc : dict
            Start document (abbe.service.runs.columns says what it holds).

        Returns
        -------
        int
            Id.

        Raises
        ------
        StoreError
            If the label is taken.
        """
        values = {"campaign_id": campaign_id, "label": label, "test": test, "role": role, "status": RUNNING, "reason": "", "start_doc": doc}
        return self._write(lambda connection: _insert_run(connection, values | {"started_utc": self._now()}))

    def finish_run(self, run_id: int, status: str, reason: str, doc: Doc | None) -> None:
        """Close a run for good.

        Parameters
        ----------
        run_id : int
            Run.
        status : str
            One of ``abbe.service.domain.measured.FINISHED``.
        reason : str
            Why, in words; empty for a complete run.
        doc : dict or None
            End document; None if the end was not reached.

        Raises
        ------
        StoreError
            If the run does not exist or is closed already.
        """
        if status not in FINISHED:
            raise StoreError(f"run status {status!r} is not one of {', '.join(FINISHED)}")
        values = {"status": status, "reason": reason, "end_doc": doc, "ended_utc": self._now()}

        def work(connection: Connection) -> None:
            done = connection.execute(update(runs).where(runs.c.id == run_id, runs.c.status == RUNNING).values(values))
            if done.rowcount != 1:
                _require_running(connection, run_id)

        self._write(work)

    def append_chunk(  # noqa: PLR0913 - one argument for each field of a chunk
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
        run_id : int
            Run.
        channel : str
            ``"bar"``, ``"laser"``, ...
        seq : int
            Number of the chunk in its channel, from 0.
        n : int
            Samples in it.
        codec : str
            How they are packed (abbe.service.runs.codec).
        payload : bytes
            The packed samples.
        first_host_s, last_host_s : float
            Monotonic host time of the first and last arrival.
        first_device_us, last_device_us : int
            Device time of the first and last sample.

        Raises
        ------
        StoreError
            If the run is closed or the chunk exists.
        """
        values = ChunkRecord(
            run_id, channel, seq, n, codec, zlib.crc32(payload), payload, first_host_s, last_host_s, first_device_us, last_device_us
        )

        def work(connection: Connection) -> None:
            _require_running(connection, run_id)
            _insert_chunk(connection, values)

        self._write(work)

    def runs(self, campaign: str | int | None = None) -> list[RunRecord]:
        """List runs in the order in which they were started.

        Parameters
        ----------
        campaign : str or int, optional
            Only this campaign's.

        Returns
        -------
        list of RunRecord
            The records.
        """
        query = _runs_query()
        if campaign is not None:
            query = query.where(runs.c.campaign_id == self.campaign(campaign).id)
        return self._select(query)

    def latest_runs(self, limit: int, *, campaign: str = "", test: str = "", status: str = "") -> list[RunRecord]:
        """List the newest runs, newest first, however many there are.

        Parameters
        ----------
        limit : int
            At most so many.
        campaign, test, status : str
            Only of this campaign, of this test, with this written status; empty: all.
        """
        query = _runs_query().order_by(None).order_by(runs.c.id.desc()).limit(limit)
        for column, wanted in ((campaigns.c.name, campaign), (runs.c.test, test), (runs.c.status, status)):
            query = query.where(column == wanted) if wanted else query
        return self._select(query)

    def run(self, id_or_label: int | str) -> RunRecord:
        """Find a run.

        Parameters
        ----------
        id_or_label : int or str
            Id (also as text), label (``"r01"``) or, where several campaigns use the label, ``"campaign/r01"``.

        Returns
        -------
        RunRecord
            The record.

        Raises
        ------
        NotStored
            If there is none.
        StoreError
            If there is more than one.
        """
        text = str(id_or_label)
        name = campaigns.c.name + "/" + runs.c.label
        found = self._select(_runs_query().where((runs.c.label == text) | (name == text))) if isinstance(id_or_label, str) else []
        if not found and text.isdecimal():
            found = self._select(_runs_query().where(runs.c.id == int(text)))
        if not found:
            raise NotStored(f"no run {text!r} in {self.url}", "`abbe runs` lists what there is")
        if len(found) > 1:
            names = ", ".join(f"{one.campaign}/{one.label}" for one in found)
            raise StoreError(f"run {text!r} exists more than once", f"write one of {names}")
        return found[0]

    def run_numbered(self, run_id: int) -> RunRecord | None:
        """The run of a number, None if there is none."""
        return next(iter(self._select(_runs_query().where(runs.c.id == run_id))), None)

    def chunks(self, run_id: int, channel: str | None = None) -> list[ChunkRecord]:
        """Read a run's samples and check that they are as they were written.

        Parameters
        ----------
        run_id : int
            Run.
        channel : str, optional
            Only this channel.

        Returns
        -------
        list of ChunkRecord
            In order of channel and seq.

        Raises
        ------
        StoreError
            Naming run and chunk, if the stored bytes have changed.
        """
        columns = [chunks.c[name] for name in ChunkRecord.__dataclass_fields__]
        query = select(*columns).where(chunks.c.run_id == run_id).order_by(chunks.c.channel, chunks.c.seq)
        if channel is not None:
            query = query.where(chunks.c.channel == channel)
        found = [ChunkRecord(*row) for row in self._read(lambda connection: connection.execute(query).all())]
        for chunk in found:
            if zlib.crc32(chunk.payload) != chunk.crc32:
                run = self.run(run_id)
                raise StoreError(
                    f"run {run.campaign}/{run.label}, chunk {chunk.seq} of channel {chunk.channel!r}: stored bytes do not match their CRC",
                    "the disk or the file is damaged: restore a backup",
                )
        return found

    def _select(self, query: Select[tuple[object, ...]]) -> list[RunRecord]:
        return [_run_record(row) for row in self._read(lambda connection: connection.execute(query).all())]


def _insert_run(connection: Connection, values: Doc) -> int:
    taken = select(runs.c.id).where(runs.c.campaign_id == values["campaign_id"], runs.c.label == values["label"])
    if connection.execute(taken).first() is not None:
        raise StoreError(f"run {values['label']!r} exists already in this campaign", "give it another label")
    me = this_process()
    owner = {"owner_host": me.host, "owner_pid": me.pid, "owner_start": me.start}
    return new_id(connection, insert(runs).values(values | owner))


def _insert_chunk(connection: Connection, chunk: ChunkRecord) -> None:
    values = {name: getattr(chunk, name) for name in ChunkRecord.__dataclass_fields__}
    try:
        connection.execute(insert(chunks).values(values))
    except IntegrityError:
        raise StoreError(f"run {chunk.run_id}: chunk {chunk.seq} of channel {chunk.channel!r} exists and is never overwritten") from None


def insert_imported(connection: Connection, campaign_id: int, run: ImportedRun, now: str) -> None:
    """Store a run that was measured elsewhere, closed from the start.

    Parameters
    ----------
    connection : Connection
        Inside a transaction.
    campaign_id : int
        Campaign.
    run : ImportedRun
        The run.
    now : str
        Time of the record.
    """
    values = {"campaign_id": campaign_id, "label": run.label, "test": run.test, "role": run.role, "start_doc": run.start_doc}
    run_id = _insert_run(connection, values | {"status": "complete", "reason": "imported", "started_utc": now, "ended_utc": now})
    _insert_chunk(connection, ChunkRecord(run_id, "columns", 0, run.n, run.codec, zlib.crc32(run.payload), run.payload, 0.0, 0.0, 0, 0))


def _require_running(connection: Connection, run_id: int) -> None:
    status = connection.execute(select(runs.c.status).where(runs.c.id == run_id)).scalar()
    if status is None:
        raise NotStored(f"no run {run_id} in the database")
    if status != RUNNING:
        raise StoreError(f"run {run_id} is closed ({status}): nothing can be added to it")


def _runs_query() -> Select[tuple[object, ...]]:
    return select(runs, campaigns.c.name.label("campaign_name")).join(campaigns, campaigns.c.id == runs.c.campaign_id).order_by(runs.c.id)


def _run_record(row: Row[tuple[object, ...]]) -> RunRecord:
    values = dict(row._mapping)  # noqa: SLF001 - SQLAlchemy's public name
    owner = Owner(values.pop("owner_host"), values.pop("owner_pid"), values.pop("owner_start"))
    return RunRecord(campaign=values.pop("campaign_name"), owner=owner, **values)
