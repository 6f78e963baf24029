"""Routes of the operator's screens. Each declares its permission, which the auth middleware checks."""

from __future__ import annotations

import re
import secrets
from collections.abc import Callable
from functools import partial

from fastapi import FastAPI, Request
from fastapi.responses import HTMLResponse, JSONResponse, RedirectResponse, Response

from abbe.service.compensation.proposal_decisions import approve as work_approve
from abbe.service.compensation.proposal_decisions import reject as work_reject
from abbe.service.compensation.proposal_decisions import same_person
from abbe.service.domain.people import Permission
from abbe.service.errors import AbbeError, NotStored, TableRefused, Unusable
from abbe.service.queries import measured
from abbe.service.queries.alarms import path_with
from abbe.service.queries.results import discoveries
from abbe.service.queries.tables import proposals
from abbe.service.rendering.document_data import shown
from abbe.service.rendering.palette import style_rules
from abbe.service.rendering.phrases import phrase
from abbe.service.web.bodies import form_of
from abbe.service.web.frame import current
from abbe.service.web.login.access import needs
from abbe.service.web.login.auth_middleware import Visit
from abbe.service.web.login.login import signature_refusal
from abbe.service.web.page import has_uplot
from abbe.service.web.pages import times
from abbe.service.web.pages.audit import add_audit
from abbe.service.web.pages.context import Number, PageContext, Text, find_or_none
from abbe.service.web.pages.proposals import MOST, outcome_texts, promise, proposal_screen, sign
from abbe.service.web.pages.result_routes import add_result_pages
from abbe.service.web.pages.results import discovery_screen, result_screen, solution_lines
from abbe.service.web.pages.run_curve import NOTHING, run_curve
from abbe.service.web.pages.runs import LONG_RUN, STATES, TESTS, RunsQuery, readings_of, run_list, run_screen, shell_of
from abbe.service.web.problems import problem

_DARK = re.compile(r"@media screen and \(prefers-color-scheme:dark\)\{:root\{([^}]*)\}\}")


def themed(rules: str) -> str:
    """Adapt `abbe.service.rendering.palette.style_rules` to pages with a choice of theme: ``data-theme`` of ``html`` sets the colours."""
    found = _DARK.search(rules)
    if found is None:
        raise ValueError("the palette lacks the expected dark colours")
    light = rules[: found.start()] + rules[found.end() :]
    first = light.replace(":root{color-scheme:light dark;", ":root figure{", 1)
    if first == light:
        raise ValueError("the palette does not begin as expected")
    automatic = f"@media screen and (prefers-color-scheme:dark){{:root:not([data-theme=light]) figure{{{found[1]}}}}}"
    return f"{first}\n{automatic}\n:root[data-theme=dark] figure{{{found[1]}}}\n"


LONGEST_FORM = 4096
LONGEST_REASON = 500
HOURS = (1.0, 8.0, 24.0, 72.0)
PLOT_STYLE = themed(style_rules())


def add_pages(app: FastAPI, context: PageContext) -> None:
    """Add the screens of runs, results, proposals, trends, timetable and audit to the application."""

    @app.get("/plots.css", include_in_schema=False)
    @needs(Permission.READ)
    async def plots() -> Response:
        return Response(PLOT_STYLE, media_type="text/css")

    _add_runs(app, context)
    _add_run_curve(app, context)
    _add_results(app, context)
    add_result_pages(app, context)
    _add_proposals(app, context)
    _add_approval(app, context)
    _add_rejection(app, context)
    _add_times(app, context)
    add_audit(app, context)


def _add_runs(app: FastAPI, context: PageContext) -> None:
    @app.get("/runs", include_in_schema=False)
    @needs(Permission.READ)
    async def runs(campaign: Text = "", test: Text = "", state: Text = "") -> HTMLResponse:
        query = RunsQuery(campaign, test, state)
        listed = await context.read(run_list, context.reader, query)
        return await context.show("runs.html", listed=listed, query=query, tests=TESTS, states=STATES)

    @app.get("/run", include_in_schema=False)
    @needs(Permission.READ)
    async def run(id: Number = None, whole: bool = False) -> HTMLResponse:
        if id is None:
            newest, _ = await context.read(measured.runs, context.reader, {}, None, 1)
            id = newest[0].number if newest else None
        record = None if id is None else await context.read(find_or_none, context.store.runs.find, id)
        if record is None and id is not None:
            return await context.missing("run", id)
        late = record is not None and not whole and await context.read(readings_of, context.store, record.id) > LONG_RUN
        make = shell_of if late else run_screen
        screen = None if record is None else await context.read(make, context.store, record, context.rules)
        report = None if screen is None or screen.document is None else shown(screen.document)
        return await context.show(
            "run.html", screen=screen, report=report, late=late, words={"plot.read": current().translate("plot.read")}
        )


def _add_run_curve(app: FastAPI, context: PageContext) -> None:
    @app.get("/run/curve", include_in_schema=False)
    @needs(Permission.READ)
    async def curve(id: Number = None, low: float = -1e12, high: float = 1e12) -> JSONResponse:
        if not low < high:
            return problem(422, "give a time that is not empty")
        if id is None:
            return JSONResponse(NOTHING)
        try:
            return JSONResponse(await context.read(run_curve, context.store, id, low, high))
        except AbbeError as error:
            return problem(404, error.detail, error.code)


def _add_results(app: FastAPI, context: PageContext) -> None:
    @app.get("/results", include_in_schema=False)
    @needs(Permission.READ)
    async def results() -> HTMLResponse:
        return await context.show("results.html", lines=await context.read(solution_lines, context.store))

    @app.get("/result", include_in_schema=False)
    @needs(Permission.READ)
    async def result(id: Number = None) -> HTMLResponse:
        newest = await context.read(solution_lines, context.store, 1) if id is None else []
        number = newest[0].id if newest else id
        record = None if number is None else await context.read(find_or_none, context.store.solutions.get, number)
        if record is None and number is not None:
            return await context.missing("solution", number)
        screen = None if record is None else await context.read(result_screen, context.store, record)
        return await context.show("result.html", screen=screen)

    @app.get("/discoveries", include_in_schema=False)
    @needs(Permission.READ)
    async def searches() -> HTMLResponse:
        return await context.show("discoveries.html", lines=(await context.read(discoveries, context.reader, None, None, None, MOST))[0])

    @app.get("/discovery", include_in_schema=False)
    @needs(Permission.READ)
    async def discovery(id: Number = None) -> HTMLResponse:
        newest = (await context.read(discoveries, context.reader, None, None, None, 1))[0] if id is None else []
        number = newest[0].number if newest else id
        try:
            screen = None if number is None else await context.read(discovery_screen, context.reader, number, context.rules)
        except NotStored:
            return await context.missing("discovery", number or 0)
        report = None if screen is None or screen.document is None else shown(screen.document)
        way = None if number is None else await context.read(path_with, context.reader, "cause", number)
        return await context.show("discovery.html", way=way, screen=screen, report=report)


def _add_proposals(app: FastAPI, context: PageContext) -> None:
    @app.get("/proposals", include_in_schema=False)
    @needs(Permission.READ)
    async def screen_of_all() -> HTMLResponse:
        lines, _ = await context.read(proposals, context.reader, None, None, MOST)
        return await context.show("proposals.html", lines=lines, sign=sign, promise=promise)

    @app.get("/proposal", include_in_schema=False)
    @needs(Permission.READ)
    async def proposal(id: Number = None) -> HTMLResponse:
        newest = (await context.read(proposals, context.reader, None, None, 1))[0] if id is None else []
        number = newest[0].number if newest else id
        if number is None:
            return await context.show("proposal.html", screen=None)
        try:
            screen = await context.read(proposal_screen, context.reader, number)
        except NotStored:
            return await context.missing("proposal", number)
        except Unusable as error:
            return await context.show("changed.html", 409, number=number, text=error.detail)
        key, texts = secrets.token_hex(8), outcome_texts("table.word")
        way = await context.read(path_with, context.reader, "proposal", number)
        mine = screen.found.two_people and same_person(screen.found.by, current().who)
        return await context.show(
            "proposal.html", way=way, screen=screen, sign=sign, promise=promise, hours=HOURS, key=key, texts=texts, mine=mine
        )


def _add_approval(app: FastAPI, context: PageContext) -> None:
    @app.post("/proposal/approve", include_in_schema=False, max_body_size=LONGEST_FORM)
    @needs(Permission.APPROVE)
    async def approve(request: Request) -> Response:
        visit: Visit = request.state.visit
        form = await form_of(request) or {}
        decision = _approval(form)
        if decision is None:
            return problem(422, "the form needs the number of a proposal, and hours between 0.01 and 720")
        number, hours = decision
        visit.target = f"proposal {number}"
        if form.get("clear") != "yes":
            return problem(422, "the form needs the confirmation that the working space is clear")
        refused = await signature_refusal(context.auth, request, form.get("password", ""))
        if refused is not None:
            return refused
        account, clock = visit.principal.name, context.reader.clock
        refused = await _decided(context, lambda: work_approve(context.store, number, current().who, hours, clock, account))
        if refused is not None:
            return refused
        # What was signed is usually wanted at once: the screen asks for the push, and the person's touch orders it.
        return RedirectResponse(f"/proposal?id={number}" + ("" if context.pushes_itself else "&push=ask"), 303)


def _add_rejection(app: FastAPI, context: PageContext) -> None:
    @app.post("/proposal/reject", include_in_schema=False, max_body_size=LONGEST_FORM)
    @needs(Permission.APPROVE)
    async def reject(request: Request) -> Response:
        visit: Visit = request.state.visit
        form = await form_of(request) or {}
        number = form.get("number", "")
        if not re.fullmatch(r"[1-9]\d{0,8}", number, re.ASCII):
            return problem(422, "the form needs the number of a proposal")
        reason = form.get("reason", "").replace("\0", "\ufffd")[:LONGEST_REASON]
        visit.target = f"proposal {number}: {reason}"
        account, clock = visit.principal.name, context.reader.clock
        work = lambda: work_reject(context.store, int(number), current().who, reason, clock, account)  # noqa: E731
        return await _decided(context, work) or RedirectResponse(f"/proposal?id={number}", 303)


async def _decided(context: PageContext, work: Callable[[], object]) -> Response | None:
    """Make a decision; return its refusal, or None."""
    try:
        await context.read(work)
    except TableRefused as error:
        told = [phrase(current().lang, text) for text in (error.detail, error.remedy) if text]
        return problem(409, " - ".join(told), error.code)
    except NotStored as error:
        return problem(404, error.detail, error.code)
    return None


def _approval(fields: dict[str, str]) -> tuple[int, float] | None:
    """Number and hours of the approval form; None if invalid."""
    try:
        number, hours = int(fields.get("number", "")), float(fields.get("hours", ""))
    except ValueError:
        return None
    return (number, hours) if 1 <= number < 2**31 and 0.01 <= hours <= 720.0 else None


def _add_times(app: FastAPI, context: PageContext) -> None:
    @app.get("/trends", include_in_schema=False)
    @needs(Permission.READ)
    async def trends(pictures: bool = False) -> HTMLResponse:
        pictures = pictures or not has_uplot()
        past, status = await context.source.verifications(times.CHECKS), await context.source.status()
        screen = await context.read(partial(times.trend_screen, context.reader, past, status, pictures=pictures))
        words = {key: current().translate(key) for key in times.PLOT_WORDS}
        values = {"plots": screen.plots, "charts": screen.charts, "checks": len(past), "words": words, "pictures": pictures}
        return await context.show("trends.html", verified=status.verified, **values)

    @app.get("/schedule", include_in_schema=False)
    @needs(Permission.READ)
    async def schedule() -> HTMLResponse:
        status = await context.source.status()
        return await context.show("schedule.html", lines=await context.read(times.schedule_lines, context.reader, status))
