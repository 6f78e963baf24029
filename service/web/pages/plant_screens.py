"""Routes of the plant screens: all machines, devices of this machine, settings and diagnostics."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal
from urllib.parse import urlencode

from fastapi import FastAPI, Query, Request
from fastapi.responses import HTMLResponse, Response
from pydantic import AfterValidator

from abbe.service.domain.audit_event import AuditEvent
from abbe.service.users.roles import Permission
from abbe.service.web import language
from abbe.service.web.api.sources import Sources
from abbe.service.web.frame import THEMES, current
from abbe.service.web.login.access import needs
from abbe.service.web.login.auth_middleware import Visit
from abbe.service.web.pages.context import PageContext, can_be_stored
from abbe.service.web.pages.devices import device_screen
from abbe.service.web.pages.diagnostics import bundle, config_of, diagnosis, megabytes
from abbe.service.web.pages.fleet import SORTS, FleetQuery, fleet_csv, fleet_lines
from abbe.service.web.units import SYSTEMS

Text = Annotated[str, Query(max_length=200), AfterValidator(can_be_stored)]
Sort = Literal["worst", "machine", "due"]
BUNDLE_ACTION = "support bundle"


def add_plant_screens(app: FastAPI, context: PageContext, sources: Sources) -> None:
    """Add the screens."""
    _add_fleet(app, context, sources)
    _add_devices(app, context, sources)
    _add_settings(app, context, sources)


def _add_fleet(app: FastAPI, context: PageContext, sources: Sources) -> None:
    @app.get("/fleet", include_in_schema=False)
    @needs(Permission.READ)
    async def fleet(name: Text = "", verdict: Text = "", sort: Sort = "worst") -> HTMLResponse:
        query, now, lang = FleetQuery(name, verdict, sort), sources.reader.clock.utc(), current().lang
        lines = await context.read(fleet_lines, sources.reader.store, now, query)

        def named(key: str) -> tuple[str, str]:
            text, unit = language.figure(lang, key)
            return text, current().unit(unit)

        return await context.show(
            "fleet.html",
            lines=lines,
            query=query,
            sorts=SORTS,
            csv=f"/fleet.csv?{urlencode({'name': name, 'verdict': verdict, 'sort': sort})}",
            ago=lambda utc: language.ago(lang, datetime.fromisoformat(utc), now),
            name=named,
            measured=lambda value, key: current().length(value, language.figure(lang, key)[1]),
        )

    @app.get("/fleet.csv", include_in_schema=False)
    @needs(Permission.READ)
    async def as_csv(name: Text = "", verdict: Text = "", sort: Sort = "worst") -> Response:
        lines = await context.read(fleet_lines, sources.reader.store, sources.reader.clock.utc(), FleetQuery(name, verdict, sort))
        headers = {"Content-Disposition": 'attachment; filename="fleet.csv"'}
        return Response(fleet_csv(lines), media_type="text/csv; charset=utf-8", headers=headers)


def _add_devices(app: FastAPI, context: PageContext, sources: Sources) -> None:
    @app.get("/devices", include_in_schema=False)
    @needs(Permission.READ)
    async def devices() -> HTMLResponse:
        status, now = await context.source.status(), sources.reader.clock.utc()
        until = sources.rules.calibrated_until
        screen = await context.read(device_screen, sources.reader.store, sources.reader.machine, status.devices, until, now.date())
        lang = current().lang
        return await context.show("devices.html", screen=screen, ago=lambda at: language.ago(lang, at, now))


def _lines(sources: Sources) -> list[str]:
    return [] if sources.tail is None else sources.tail.lines()


def _add_settings(app: FastAPI, context: PageContext, sources: Sources) -> None:
    @app.get("/settings", include_in_schema=False)
    @needs(Permission.READ)
    async def settings() -> HTMLResponse:
        users = await context.read(sources.reader.store.people.all) if current().may(Permission.USERS) else []
        return await context.show("settings.html", themes=THEMES, systems=SYSTEMS, names=language.NAMES, users=users)

    @app.get("/diagnostics", include_in_schema=False)
    @needs(Permission.CONFIGURE)
    async def diagnostics() -> HTMLResponse:
        found = await context.read(diagnosis, sources, app.version)
        return await context.show("diagnostics.html", found=found, log=_lines(sources), megabytes=megabytes)

    @app.get("/support.zip", include_in_schema=False)
    @needs(Permission.CONFIGURE)
    async def support(request: Request) -> Response:
        visit: Visit = request.state.visit
        status = await context.source.status()
        found = await context.read(diagnosis, sources, app.version)
        log = _lines(sources)
        made = await context.read(bundle, found, config_of(sources, status, status.mqtt.broker), status, log)
        # The bundle takes data out of the plant: without a record in the audit it is not sent.
        event = AuditEvent(
            who=visit.principal.name,
            action=BUNDLE_ACTION,
            target=sources.reader.machine,
            outcome="done",
            doc={"address": visit.address, "bytes": len(made)},
        )
        await context.auth.record(event)
        headers = {"Content-Disposition": 'attachment; filename="abbe-support.zip"', "Cache-Control": "no-store"}
        return Response(made, media_type="application/zip", headers=headers)
