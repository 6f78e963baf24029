"""The screens of the alarms (ISA-18.2, IEC 62682): list, one alarm with its history, acknowledge with a comment, shelve for a time."""

from __future__ import annotations

from collections.abc import Callable

from fastapi import FastAPI, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response

from abbe.service.domain.people import Permission
from abbe.service.queries.alarms import alarm_lines, path_of_alarm
from abbe.service.queries.status import AlarmSummary, alarms
from abbe.service.storage.repositories.pages import LARGEST
from abbe.service.verification.alarms import acknowledge, shelve
from abbe.service.web.bodies import form_of
from abbe.service.web.login.access import needs
from abbe.service.web.login.auth_middleware import Visit
from abbe.service.web.pages.context import Number, PageContext
from abbe.service.web.problems import problem
from abbe.service.web.strip import alarm_line

LONGEST_FORM = 4096
LONGEST_TEXT = 500
SHELF_H = (1, 8, 24, 168)
MOST_OVER = 100
"""Number of closed alarms in the history."""


def add_alarm_pages(app: FastAPI, context: PageContext) -> None:
    """Add the screens of alarms and their two forms to the application."""
    store, machine = context.store, context.reader.machine

    @app.get("/alarms", include_in_schema=False)
    @needs(Permission.READ)
    async def listed() -> HTMLResponse:
        status = await context.source.status()
        every = await context.read(lambda: alarms(context.store, status.machine, every=True))
        over = [one for one in every if one.state == "closed"]
        there = sorted((one for one in every if one.state != "closed"), key=lambda one: _order(one, one.is_shelved(status.now_utc)))
        return await context.show("alarms.html", there=there, over=over[:MOST_OVER], now=status.now_utc, line=alarm_line)

    @app.get("/alarm", include_in_schema=False)
    @needs(Permission.READ)
    async def alarm(id: Number = None) -> Response:
        status = await context.source.status()
        every = await context.read(lambda: alarms(context.store, status.machine, every=True))
        found = next((one for one in every if id is None or one.alarm == id), None)
        if found is None:
            return await listed() if id is None else await context.missing("alarm", id)
        lines = await context.read(alarm_lines, context.store, status.machine, found.alarm)
        way = await context.read(path_of_alarm, context.reader, found.alarm)
        return await context.show("alarm.html", way=way, one=found, lines=lines, now=status.now_utc, line=alarm_line, hours=SHELF_H)

    @app.post("/alarm/acknowledge", include_in_schema=False, max_body_size=LONGEST_FORM)
    @needs(Permission.ACKNOWLEDGE)
    async def seen(request: Request) -> Response:
        return await _changed(request, context, lambda n, who, form: acknowledge(store, machine, n, who, form.get("comment", "")))

    @app.post("/alarm/shelve", include_in_schema=False, max_body_size=LONGEST_FORM)
    @needs(Permission.ACKNOWLEDGE)
    async def shelf(request: Request) -> Response:
        return await _changed(
            request, context, lambda number, who, form: shelve(store, machine, number, who, form.get("reason", ""), float(form["hours"]))
        )


def _order(one: AlarmSummary, shelved: bool) -> tuple[bool, int, int, int]:
    """Return the sort key of an alarm: shelved ones last; unseen and active ones first, by priority, then the newest."""
    return shelved, {"raised": 0, "cleared": 1}.get(one.state, 2), one.priority, -one.alarm


async def _changed(request: Request, context: PageContext, work: Callable[[int, str, dict[str, str]], object]) -> Response:
    """Apply a form to an alarm, and show the alarm; a refusal gives the reason."""
    visit: Visit = request.state.visit
    form = {key: value.replace("\0", "\ufffd")[:LONGEST_TEXT] for key, value in (await form_of(request) or {}).items()}
    try:
        number = int(form.get("number", ""))
        if not 0 < number <= LARGEST:
            raise ValueError
        visit.target = f"alarm {number}"
        await context.read(work, number, visit.principal.name.partition(":")[2].partition("/")[0], form)
    except (KeyError, ValueError, OverflowError):
        return problem(422, "the form needs the number of an alarm, and hours to shelve it")
    return RedirectResponse(f"/alarm?id={number}", 303)
