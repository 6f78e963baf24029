"""Routes: machines, campaigns, runs and their samples; devices, recipes, the timetable, and error codes."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import FastAPI, Query
from fastapi.responses import Response

from abbe.service.domain.people import Permission
from abbe.service.queries import measured
from abbe.service.queries.timetable import schedule_state
from abbe.service.sequences.recipes.campaigns import RECIPES
from abbe.service.storage.repositories.pages import LARGEST
from abbe.service.web.api.sources import Cursor, Filter, Limit, Number, Sources
from abbe.service.web.catalogue import entries
from abbe.service.web.login.access import needs
from abbe.service.web.schemas import CampaignList, DeviceList, ErrorList, MachineList, Recipe, RecipeList, RunList, Timetable

JSON_ROWS = 10_000
BINARY_ROWS = 100_000
First = Annotated[int, Query(ge=0, le=LARGEST, description="Number of the first row, from 0.")]
Rows = Annotated[int, Query(ge=1, le=JSON_ROWS)]
ChannelName = Annotated[str, Query(description="A name from the run's `channels`.")]
WrittenState = Annotated[str | None, Query(description="As stored: a run whose process died is `running` here.")]
OCTETS: dict[int | str, dict[str, Any]] = {
    200: {
        "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
        "description": "18 bytes a sample, little endian: seq uint32, device_us uint64, reading_nm int32, status uint16",
    }
}


def add_measured(app: FastAPI, sources: Sources) -> None:
    """Add the routes of machines, campaigns, runs and samples to the application."""
    _add_machines(app, sources)
    _add_runs(app, sources)
    _add_samples(app, sources)


def _add_machines(app: FastAPI, sources: Sources) -> None:
    @app.get("/api/v1/machines")
    @needs(Permission.READ)
    def machines(name: Filter = None, cursor: Cursor = None, limit: Limit = 50) -> MachineList:
        """Machines in the store, with their nominal geometry."""
        found, after = measured.machines(sources.reader, name, cursor, limit)
        return MachineList(machines=found, next_cursor=after)

    @app.get("/api/v1/machines/{number}")
    @needs(Permission.READ)
    def machine(number: Number) -> measured.MachineDescription:
        """One description of a machine."""
        return measured.machine(sources.reader, number)

    @app.get("/api/v1/campaigns")
    @needs(Permission.READ)
    def campaigns(machine: Filter = None, cursor: Cursor = None, limit: Limit = 50) -> CampaignList:
        """Campaigns, newest first."""
        found, after = measured.campaigns(sources.reader, machine, cursor, limit)
        return CampaignList(campaigns=found, next_cursor=after)

    @app.get("/api/v1/campaigns/{number}")
    @needs(Permission.READ)
    def campaign(number: Number) -> measured.CampaignDetail:
        """A campaign with its runs."""
        return measured.campaign(sources.reader, number)


def _add_runs(app: FastAPI, sources: Sources) -> None:
    @app.get("/api/v1/runs")
    @needs(Permission.READ)
    def runs(
        campaign: Filter = None,
        machine: Filter = None,
        test: Filter = None,
        role: Filter = None,
        status: WrittenState = None,
        cursor: Cursor = None,
        limit: Limit = 50,
    ) -> RunList:
        """Runs, newest first, including those that were broken off."""
        filters = {"campaign": campaign, "machine": machine, "test": test, "role": role, "status": status}
        found, after = measured.runs(sources.reader, filters, cursor, limit)
        return RunList(runs=found, next_cursor=after)

    @app.get("/api/v1/runs/{number}")
    @needs(Permission.READ)
    def run(number: Number) -> measured.RunDetail:
        """One run with its channels."""
        return measured.run(sources.reader, number)


def _add_samples(app: FastAPI, sources: Sources) -> None:
    @app.get("/api/v1/runs/{number}/samples")
    @needs(Permission.READ)
    def stretch(number: Number, channel: ChannelName = "bar", first: First = 0, limit: Rows = 1000) -> measured.Samples:
        """Consecutive samples of one channel, as they arrived."""
        return measured.samples(sources.reader, number, channel, first, limit)

    @app.get("/api/v1/runs/{number}/samples.bin", response_class=Response, responses=OCTETS)
    @needs(Permission.READ)
    def packed(number: Number, first: First = 0, limit: Annotated[int, Query(ge=1, le=BINARY_ROWS)] = BINARY_ROWS) -> Response:
        """Consecutive samples of the ball-bar, packed as bytes."""
        data, total = measured.packed_samples(sources.reader, number, first, limit)
        return Response(data, media_type="application/octet-stream", headers={"Abbe-Total": str(total)})

    @app.get("/api/v1/runs/{number}/columns")
    @needs(Permission.READ)
    def columns(number: Number, first: First = 0, limit: Rows = 1000) -> measured.RunColumns:
        """Consecutive evaluated readings: position, time, deviation."""
        return measured.columns(sources.reader, number, first, limit)


def add_plant(app: FastAPI, sources: Sources) -> None:
    """Add the routes of devices, recipes, timetable and error codes to the application."""
    machine = sources.reader.machine

    @app.get("/api/v1/errors")
    @needs(Permission.READ)
    def errors() -> ErrorList:
        """All error codes with their meanings."""
        return ErrorList(errors=entries())

    @app.get("/api/v1/devices")
    @needs(Permission.READ)
    def devices() -> DeviceList:
        """Devices of this service's machine and the time of their last answer."""
        return DeviceList(machine=machine, devices=sources.devices())

    @app.get("/api/v1/recipes")
    @needs(Permission.READ)
    def recipes() -> RecipeList:
        """Builtin recipes that a schedule can name."""
        return RecipeList(recipes=[Recipe(name=name, about=_about(make)) for name, make in sorted(RECIPES.items())])

    @app.get("/api/v1/schedules")
    @needs(Permission.READ)
    def schedules() -> Timetable:
        """The timetable with the next slot of each schedule and the outcome of the latest slots."""
        return Timetable(machine=machine, schedules=[schedule_state(sources.reader, one) for one in sources.schedules])


def _about(make: object) -> str:
    return " ".join((make.__doc__ or "").split())
