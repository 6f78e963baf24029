"""Routes: machines, campaigns, runs and what the runs hold."""

from __future__ import annotations

import zlib
from typing import Annotated, Any

from fastapi import FastAPI, Query
from fastapi.responses import Response

from abbe.service.domain.measured import ChunkRecord
from abbe.service.errors import NotStored, StoreError
from abbe.service.runs.codec import BAR_CODEC, JSON_CODEC, decode_bar, decode_json, pack_bar
from abbe.service.runs.columns import IMPORTED_CHANNEL, load_run
from abbe.service.runs.machine_object import MachineObject
from abbe.service.storage.repositories.pages import LARGEST, visible_status
from abbe.service.storage.store import Store
from abbe.service.users.roles import Permission
from abbe.service.web.api import shapes as s
from abbe.service.web.api.shapes import BarSamples, Columns, Samples
from abbe.service.web.api.sources import Cursor, Doc, Filter, Limit, Number, Sources, as_stored, finite, read_as, storable
from abbe.service.web.login.access import needs

# Stretches of a run's samples: only the chunks that are asked for are read and unpacked.


JSON_ROWS = 10_000
BINARY_ROWS = 100_000


def stretch(store: Store, run: int, channel: str, first: int, limit: int) -> Samples:
    """Samples ``first`` to ``first + limit - 1`` of a channel.

    Raises
    ------
    NotStored
        The run has no such channel; what was imported has only columns.
    """
    with as_stored():
        found, before, total = _chunks(store, run, channel, first, limit)
        codecs = {chunk.codec for chunk in found}
        at = slice(first - before, first - before + limit)
        if codecs <= {BAR_CODEC} and channel == "bar":
            samples = [sample for chunk in found for sample in decode_bar(chunk.payload)][at]
            names = ("seq", "device_us", "reading_nm", "status")
            bar = BarSamples(**{name: [getattr(one, name) for one in samples] for name in names})
            return Samples(run=run, channel=channel, first=first, count=len(samples), total=total, bar=bar)
        if not codecs <= {JSON_CODEC}:
            raise StoreError(f"run {run}, channel {channel!r}: packed in another way ({', '.join(sorted(codecs))})", "use a newer Abbe")
        records = [finite(one) for chunk in found for one in decode_json(chunk.payload)][at]
    return Samples(run=run, channel=channel, first=first, count=len(records), total=total, records=records)


def binary_stretch(store: Store, run: int, first: int, limit: int) -> tuple[bytes, int]:
    """The same of the ball-bar, packed, and how many samples there are in all."""
    with as_stored():
        found, before, total = _chunks(store, run, "bar", first, limit)
        samples = [sample for chunk in found for sample in decode_bar(chunk.payload)]
    return pack_bar(samples[first - before : first - before + limit]), total


def columns_stretch(store: Store, run: int, first: int, limit: int) -> Columns:
    """Rows ``first`` to ``first + limit - 1`` of a run's evaluated columns.

    Raises
    ------
    Unusable, MeasurementFault
        The run is not complete enough to be evaluated.
    """
    with as_stored():
        columns = load_run(store, run)["columns"]
    total = max((len(values) for values in columns.values() if values is not None), default=0)
    part = {name: None if values is None else finite(values[first : first + limit]) for name, values in columns.items()}
    return Columns(run=run, first=first, count=max(0, min(limit, total - first)), total=total, columns=part)


def _chunks(store: Store, run: int, channel: str, first: int, limit: int) -> tuple[list[ChunkRecord], int, int]:
    """Chunks that hold a stretch, the number of their first sample, and how many samples the channel has."""
    sizes = store.chunk_sizes(run, channel) if storable(channel) and channel != IMPORTED_CHANNEL else []
    if not sizes:
        raise NotStored(
            f"run {run} has no samples of channel {channel[:40]!r}", "the run's `channels` name them; imported runs have columns"
        )
    wanted: list[int] = []
    before = at = 0
    for seq, n in sizes:
        if at + n > first and at < first + limit:
            before = at if not wanted else before
            wanted.append(seq)
        at += n
    found = store.chunk_range(run, channel, wanted[0], wanted[-1]) if wanted else []
    for chunk in found:
        if zlib.crc32(chunk.payload) != chunk.crc32:
            raise StoreError(f"run {run}, chunk {chunk.seq} of channel {channel!r}: stored bytes do not match their CRC")
    return found, before if wanted else first, at


First = Annotated[int, Query(ge=0, le=LARGEST, description="Number of the first one, from 0.")]
ChannelName = Annotated[str, Query(description="As the run's `channels` name it.")]
OCTETS: dict[int | str, dict[str, Any]] = {
    200: {
        "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
        "description": "18 bytes a sample, little endian: seq uint32, device_us uint64, reading_nm int32, status uint16",
    }
}


def add_measured(app: FastAPI, sources: Sources) -> None:
    """Add the routes."""
    _add_machines(app, sources)
    _add_campaigns(app, sources)
    _add_runs(app, sources)
    _add_samples(app, sources)


def _add_machines(app: FastAPI, sources: Sources) -> None:
    @app.get("/api/v1/machines")
    @needs(Permission.READ)
    def machines(name: Filter = None, cursor: Cursor = None, limit: Limit = 50) -> s.Machines:
        """Machines that the store knows, with their nominal geometry."""
        rows, after = sources.page("machines", {"name": name}, cursor, limit)
        return s.Machines(machines=[_machine(row) for row in rows], next_cursor=after)

    @app.get("/api/v1/machines/{number}")
    @needs(Permission.READ)
    def machine(number: Number) -> s.Machine:
        """One description of a machine."""
        return _machine(sources.row("machines", number, "machine"))


def _add_campaigns(app: FastAPI, sources: Sources) -> None:
    @app.get("/api/v1/campaigns")
    @needs(Permission.READ)
    def campaigns(machine: Filter = None, cursor: Cursor = None, limit: Limit = 50) -> s.Campaigns:
        """Campaigns, newest first."""
        rows, after = sources.page("campaigns", {"machine": machine}, cursor, limit)
        return s.Campaigns(campaigns=[s.Campaign(number=row["id"], **row) for row in rows], next_cursor=after)

    @app.get("/api/v1/campaigns/{number}")
    @needs(Permission.READ)
    def campaign(number: Number) -> s.CampaignDetail:
        """A campaign with its runs."""
        row = sources.row("campaigns", number, "campaign")
        given = {"campaign": row["name"]}
        runs = [run_of(one) for one in reversed(sources.store.page("runs", given, None, 10_000))]
        solutions, discoveries = (
            [one["id"] for one in sources.store.page(kind, given, None, 1000)] for kind in ("solutions", "discoveries")
        )
        return s.CampaignDetail(number=row["id"], runs=runs, solutions=solutions, discoveries=discoveries, **row)


def _add_runs(app: FastAPI, sources: Sources) -> None:
    @app.get("/api/v1/runs")
    @needs(Permission.READ)
    def runs(
        campaign: Filter = None,
        machine: Filter = None,
        test: Filter = None,
        role: Filter = None,
        status: Annotated[str | None, Query(description="As written: a run whose process died is `running` here.")] = None,
        cursor: Cursor = None,
        limit: Limit = 50,
    ) -> s.Runs:
        """Runs, newest first, also those that were broken off."""
        given = {"campaign": campaign, "machine": machine, "test": test, "role": role, "status": status}
        rows, after = sources.page("runs", given, cursor, limit)
        return s.Runs(runs=[run_of(row) for row in rows], next_cursor=after)

    @app.get("/api/v1/runs/{number}")
    @needs(Permission.READ)
    def run(number: Number) -> s.RunDetail:
        """One run, and which channels it holds."""
        row = sources.row("runs", number, "run")
        end = sources.store.run(number).end_doc or {}
        channels = [s.Channel.model_validate(one, from_attributes=True) for one in sources.store.channels(number)]
        return s.RunDetail(**run_of(row).model_dump(), channels=channels, gaps=len(end.get("gaps") or []))


def _add_samples(app: FastAPI, sources: Sources) -> None:
    @app.get("/api/v1/runs/{number}/samples")
    @needs(Permission.READ)
    def samples(
        number: Number, channel: ChannelName = "bar", first: First = 0, limit: Annotated[int, Query(ge=1, le=JSON_ROWS)] = 1000
    ) -> s.Samples:
        """A stretch of a channel as it arrived."""
        sources.row("runs", number, "run")
        return stretch(sources.store, number, channel, first, limit)

    @app.get("/api/v1/runs/{number}/samples.bin", response_class=Response, responses=OCTETS)
    @needs(Permission.READ)
    def samples_binary(number: Number, first: First = 0, limit: Annotated[int, Query(ge=1, le=BINARY_ROWS)] = BINARY_ROWS) -> Response:
        """A stretch of the ball-bar's samples, packed."""
        sources.row("runs", number, "run")
        data, total = binary_stretch(sources.store, number, first, limit)
        return Response(data, media_type="application/octet-stream", headers={"Abbe-Total": str(total)})

    @app.get("/api/v1/runs/{number}/columns")
    @needs(Permission.READ)
    def columns(number: Number, first: First = 0, limit: Annotated[int, Query(ge=1, le=JSON_ROWS)] = 1000) -> s.Columns:
        """A stretch of the evaluated readings: position, time, deviation."""
        sources.row("runs", number, "run")
        return columns_stretch(sources.store, number, first, limit)


def run_of(row: Doc) -> s.Run:
    """A row as an answer."""
    return s.Run(number=row["id"], run_id=row["label"], **(row | {"status": visible_status(row)}))


def _machine(row: Doc) -> s.Machine:
    return s.Machine(number=row["id"], name=row["name"], created_utc=row["created_utc"], description=read_as(MachineObject, row["doc"]))
