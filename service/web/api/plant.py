"""Routes: devices, recipes, the timetable, and error codes."""

from __future__ import annotations

from fastapi import FastAPI

from abbe.service.queries.timetable import schedule_state
from abbe.service.sequences.recipes.campaigns import RECIPES
from abbe.service.users.roles import Permission
from abbe.service.web.api.sources import Sources
from abbe.service.web.catalogue import entries
from abbe.service.web.login.access import needs
from abbe.service.web.schemas import DeviceList, ErrorList, Recipe, RecipeList, Timetable


def add_plant(app: FastAPI, sources: Sources) -> None:
    """Add the routes."""
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
