"""Routes: devices, recipes, the timetable, checks of all machines, and the codes of errors."""

from __future__ import annotations

from dataclasses import asdict

from fastapi import FastAPI

from abbe.service.campaigns.builtin_recipes import RECIPES
from abbe.service.domain.schedule import Schedule
from abbe.service.errors import Unusable
from abbe.service.scheduler.slots import cron_in_words, next_slot
from abbe.service.users.roles import Permission
from abbe.service.web.api import shapes as s
from abbe.service.web.api.sources import Cursor, Doc, Filter, Limit, Number, Sources, finite, read_as
from abbe.service.web.catalogue import entries
from abbe.service.web.login.access import needs
from abbe.service.web.schemas import Verification

LATEST = 10
BLANK: Doc = {
    "schedule": "", "recipe": "", "duration_s": 0.0, "values": {}, "uncertainties": {}, "limits": {}, "runs": [], "text": "",
}  # fmt: skip
"""What a check lacks that no schedule ordered."""


def add_plant(app: FastAPI, sources: Sources) -> None:
    """Add the routes."""
    _add_machine(app, sources)
    _add_checks(app, sources)

    @app.get("/api/v1/errors")
    @needs(Permission.READ)
    def errors() -> s.ErrorCodes:
        """Every code that an error can have, and what it means."""
        return s.ErrorCodes(errors=[s.ErrorCode(**asdict(one)) for one in entries()])


def _add_machine(app: FastAPI, sources: Sources) -> None:
    @app.get("/api/v1/devices")
    @needs(Permission.READ)
    def devices() -> s.Devices:
        """Devices of this service's machine, and when they were last heard of."""
        return s.Devices(machine=sources.machine, devices=list(sources.devices()))

    @app.get("/api/v1/recipes")
    @needs(Permission.READ)
    def recipes() -> s.Recipes:
        """Shipped recipes that a schedule can name."""
        return s.Recipes(recipes=[s.Recipe(name=name, about=_about(make)) for name, make in sorted(RECIPES.items())])

    @app.get("/api/v1/schedules")
    @needs(Permission.READ)
    def schedules() -> s.Schedules:
        """The timetable with what is due next, and what became of the latest slots."""
        return s.Schedules(machine=sources.machine, schedules=[_state(sources, one) for one in sources.schedules])


def _about(make: object) -> str:
    return " ".join((make.__doc__ or "").split())


def _state(sources: Sources, one: Schedule) -> s.ScheduleState:
    slots = sources.store.slots_of(f"{sources.machine}/{one.name}", LATEST)
    return s.ScheduleState(
        name=one.name,
        recipe=one.recipe,
        cron=one.cron,
        every_h=one.every_h,
        timezone=one.timezone,
        grace_s=one.grace_s,
        catch_up=one.catch_up,
        in_words=cron_in_words(one),
        next_due_utc=next_slot(one, sources.clock.utc()),
        latest=[s.Slot.model_validate(slot, from_attributes=True) for slot in slots],
    )


def _add_checks(app: FastAPI, sources: Sources) -> None:
    @app.get("/api/v1/checks")
    @needs(Permission.READ)
    def checks(machine: Filter = None, verdict: Filter = None, cursor: Cursor = None, limit: Limit = 50) -> s.VerificationPage:
        """Checks of all machines of the store, newest first."""
        rows, after = sources.page("verifications", {"machine": machine, "verdict": verdict}, cursor, limit)
        found = [one for row in rows if (one := _check(row)) is not None]
        return s.VerificationPage(verifications=found, next_cursor=after)

    @app.get("/api/v1/checks/{number}")
    @needs(Permission.READ)
    def check(number: Number) -> Verification:
        """One check: figures with uncertainties (k = 2), limits, verdict."""
        found = _check(sources.row("verifications", number, "check"))
        if found is None:
            raise Unusable(f"check {number} was stored in another form")
        return found


def _check(row: Doc) -> Verification | None:
    known = {"id": row["id"], "verdict": row["verdict"], "machine": row["machine"]}
    return read_as(Verification, BLANK | {"slot_utc": row["utc"], "started_utc": row["utc"]} | finite(row["doc"]) | known)
