"""Routes: devices, recipes, the timetable, and the codes of errors."""

from __future__ import annotations

from fastapi import FastAPI

from abbe.service.campaigns.builtin_recipes import RECIPES
from abbe.service.queries.timetable import schedule_state
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
        """Every code that an error can have, and what it means."""
        return ErrorList(errors=entries())

    @app.get("/api/v1/devices")
    @needs(Permission.READ)
    def devices() -> DeviceList:
        """Devices of this service's machine, and when they were last heard of."""
        return DeviceList(machine=machine, devices=sources.devices())

    @app.get("/api/v1/recipes")
    @needs(Permission.READ)
    def recipes() -> RecipeList:
        """Builtin recipes that a schedule can name."""
        return RecipeList(recipes=[Recipe(name=name, about=_about(make)) for name, make in sorted(RECIPES.items())])

    @app.get("/api/v1/schedules")
    @needs(Permission.READ)
    def schedules() -> Timetable:
        """The timetable with what is due next, and what became of the latest slots."""
        return Timetable(machine=machine, schedules=[schedule_state(sources.reader, one) for one in sources.schedules])


def _about(make: object) -> str:
    return " ".join((make.__doc__ or "").split())
