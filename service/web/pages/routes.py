"""The addresses of the operator's screens. Every one says what it needs; the guard lets through who has it."""

from __future__ import annotations

import re
import secrets
from typing import Annotated
from urllib.parse import parse_qs

from fastapi import FastAPI, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from pydantic import AfterValidator

from abbe.service.compensation.proposal_states import approve_waiting
from abbe.service.errors import NotStored, TableRefused, Unusable
from abbe.service.queries import measured
from abbe.service.queries.proposals import proposals
from abbe.service.queries.results import discoveries
from abbe.service.rendering.document_data import shown
from abbe.service.rendering.palette import style_rules
from abbe.service.users.roles import Permission
from abbe.service.web.login.access import needs
from abbe.service.web.login.auth_middleware import Visit
from abbe.service.web.pages import times
from abbe.service.web.pages.desk import PageContext, can_be_stored, found
from abbe.service.web.pages.proposals import MOST, promise, proposal_screen, sign
from abbe.service.web.pages.result_routes import add_result_pages
from abbe.service.web.pages.results import discovery_screen, result_screen, solution_lines
from abbe.service.web.pages.runs import STATES, TESTS, RunsQuery, run_list, run_screen
from abbe.service.web.pages.table import ends
from abbe.service.web.problems import problem

# The colours of the reports' pictures on a screen: of the figures, not of the page, and dark where the reader has chosen dark.


_DARK = re.compile(r"@media screen and \(prefers-color-scheme:dark\)\{:root\{([^}]*)\}\}")


def themed(rules: str) -> str:
    """The rules of `abbe.service.rendering.palette.style_rules`, for figures of a page whose ``html`` says which scheme was chosen."""
    found = _DARK.search(rules)
    if found is None:
        raise ValueError("the palette has no dark colours in the form that is expected here")
    light = rules[: found.start()] + rules[found.end() :]
    first = light.replace(":root{color-scheme:light dark;", ":root figure{", 1)
    if first == light:
        raise ValueError("the palette does not begin as is expected here")
    asked = f"@media screen and (prefers-color-scheme:dark){{:root:not([data-theme=light]) figure{{{found[1]}}}}}"
    return f"{first}\n{asked}\n:root[data-theme=dark] figure{{{found[1]}}}\n"


LONGEST_FORM = 1024
HOURS = (1.0, 8.0, 24.0, 72.0)
Number = Annotated[int | None, Query(ge=1, le=2**31 - 1)]
Text = Annotated[str, Query(max_length=200), AfterValidator(can_be_stored)]
PLOT_STYLE = themed(style_rules())


def add_pages(app: FastAPI, desk: PageContext) -> None:
    """Add the screens to the application."""

    @app.get("/plots.css", include_in_schema=False)
    @needs(Permission.READ)
    async def plots() -> Response:
        return Response(PLOT_STYLE, media_type="text/css")

    _add_runs(app, desk)
    _add_results(app, desk)
    add_result_pages(app, desk)
    _add_proposals(app, desk)
    _add_approval(app, desk)
    _add_times(app, desk)


def _add_runs(app: FastAPI, desk: PageContext) -> None:
    @app.get("/runs", include_in_schema=False)
    @needs(Permission.READ)
    async def runs(campaign: Text = "", test: Text = "", state: Text = "") -> HTMLResponse:
        wanted = RunsQuery(campaign, test, state)
        listed = await desk.read(run_list, desk.reader, wanted)
        return await desk.show("runs.html", listed=listed, wanted=wanted, tests=TESTS, states=STATES)

    @app.get("/run", include_in_schema=False)
    @needs(Permission.READ)
    async def run(id: Number = None) -> HTMLResponse:
        if id is None:
            newest, _ = await desk.read(measured.runs, desk.reader, {}, None, 1)
            id = newest[0].number if newest else None
        record = None if id is None else await desk.read(found, desk.store.run, id)
        if record is None and id is not None:
            return await desk.missing("run", id)
        screen = None if record is None else await desk.read(run_screen, desk.store, record, desk.rules)
        told = None if screen is None or screen.document is None else shown(screen.document)
        return await desk.show("run.html", screen=screen, told=told)


def _add_results(app: FastAPI, desk: PageContext) -> None:
    @app.get("/results", include_in_schema=False)
    @needs(Permission.READ)
    async def results() -> HTMLResponse:
        return await desk.show("results.html", lines=await desk.read(solution_lines, desk.store))

    @app.get("/result", include_in_schema=False)
    @needs(Permission.READ)
    async def result(id: Number = None) -> HTMLResponse:
        newest = await desk.read(solution_lines, desk.store, 1) if id is None else []
        number = newest[0].id if newest else id
        record = None if number is None else await desk.read(found, desk.store.solution, number)
        if record is None and number is not None:
            return await desk.missing("solution", number)
        screen = None if record is None else await desk.read(result_screen, desk.store, record)
        return await desk.show("result.html", screen=screen)

    @app.get("/discoveries", include_in_schema=False)
    @needs(Permission.READ)
    async def searches() -> HTMLResponse:
        return await desk.show("discoveries.html", lines=(await desk.read(discoveries, desk.reader, None, None, None, MOST))[0])

    @app.get("/discovery", include_in_schema=False)
    @needs(Permission.READ)
    async def discovery(id: Number = None) -> HTMLResponse:
        newest = (await desk.read(discoveries, desk.reader, None, None, None, 1))[0] if id is None else []
        number = newest[0].number if newest else id
        try:
            screen = None if number is None else await desk.read(discovery_screen, desk.reader, number, desk.rules)
        except NotStored:
            return await desk.missing("discovery", number or 0)
        told = None if screen is None or screen.document is None else shown(screen.document)
        return await desk.show("discovery.html", screen=screen, told=told)


def _add_proposals(app: FastAPI, desk: PageContext) -> None:
    @app.get("/proposals", include_in_schema=False)
    @needs(Permission.READ)
    async def screen_of_all() -> HTMLResponse:
        lines, _ = await desk.read(proposals, desk.reader, None, None, MOST)
        return await desk.show("proposals.html", lines=lines, sign=sign, promise=promise)

    @app.get("/proposal", include_in_schema=False)
    @needs(Permission.READ)
    async def proposal(id: Number = None) -> HTMLResponse:
        newest = (await desk.read(proposals, desk.reader, None, None, 1))[0] if id is None else []
        number = newest[0].number if newest else id
        if number is None:
            return await desk.show("proposal.html", screen=None)
        try:
            screen = await desk.read(proposal_screen, desk.reader, number)
        except NotStored:
            return await desk.missing("proposal", number)
        except Unusable as error:
            return await desk.show("changed.html", 409, number=number, text=error.detail)
        key, words = secrets.token_hex(8), ends("table.word")
        return await desk.show("proposal.html", screen=screen, sign=sign, promise=promise, hours=HOURS, key=key, words=words)


def _add_approval(app: FastAPI, desk: PageContext) -> None:
    @app.post("/proposal/approve", include_in_schema=False, max_body_size=LONGEST_FORM)
    @needs(Permission.APPROVE)
    async def approve(request: Request) -> Response:
        visit: Visit = request.state.visit
        asked = _approval(await _form(request))
        if asked is None:
            return problem(422, "the form names no proposal, or hours that are not between 0.01 and 720")
        number, hours = asked
        visit.target = f"proposal {number}"
        account = visit.principal.name
        name = account.partition(":")[2].partition("/")[0]
        try:
            await desk.read(approve_waiting, desk.store, number, name, hours, desk.reader.clock, account)
        except TableRefused as error:
            return problem(409, str(error), error.code)
        except NotStored as error:
            return problem(404, error.detail, error.code)
        return RedirectResponse(f"/proposal?id={number}", 303)


def _approval(fields: dict[str, str]) -> tuple[int, float] | None:
    """Number and hours of a form."""
    try:
        number, hours = int(fields.get("number", "")), float(fields.get("hours", ""))
    except ValueError:
        return None
    return (number, hours) if 1 <= number < 2**31 and 0.01 <= hours <= 720.0 else None


async def _form(request: Request) -> dict[str, str]:
    """Fields of a short form; empty where it is too long."""
    body = b""
    async for piece in request.stream():
        body += piece
        if len(body) > LONGEST_FORM:
            return {}
    try:
        return {key: values[0] for key, values in parse_qs(body.decode("utf-8", "replace"), max_num_fields=8).items()}
    except ValueError:  # more fields than that
        return {}


def _add_times(app: FastAPI, desk: PageContext) -> None:
    @app.get("/trends", include_in_schema=False)
    @needs(Permission.READ)
    async def trends() -> HTMLResponse:
        past, moment = await desk.source.verifications(times.CHECKS), await desk.source.status()
        screen = await desk.read(times.trend_screen, desk.reader, past, moment)
        return await desk.show("trends.html", verified=moment.verified, plots=screen.plots, charts=screen.charts, checks=len(past))

    @app.get("/schedule", include_in_schema=False)
    @needs(Permission.READ)
    async def schedule() -> HTMLResponse:
        moment = await desk.source.status()
        return await desk.show("schedule.html", lines=await desk.read(times.schedule_lines, desk.reader, moment))

    @app.get("/audit", include_in_schema=False)
    @needs(Permission.AUDIT)
    async def audit() -> HTMLResponse:
        records = await desk.read(desk.store.audit, times.AUDIT_ROWS)
        return await desk.show("audit.html", records=list(reversed(records)))
