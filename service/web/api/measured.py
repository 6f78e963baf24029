"""Routes: machines, campaigns, runs and what the runs hold."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import FastAPI, Query
from fastapi.responses import Response

from abbe.service.runs.machine_object import MachineObject
from abbe.service.storage.repositories.pages import LARGEST, visible_status
from abbe.service.users.roles import Permission
from abbe.service.web.api import shapes as s
from abbe.service.web.api.samples import BINARY_ROWS, JSON_ROWS, binary_stretch, columns_stretch, stretch
from abbe.service.web.api.sources import Cursor, Doc, Filter, Limit, Number, Sources, read_as
from abbe.service.web.login.access import needs

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
