"""Routes of the result screens: volume map, what-if, budget, comparison of runs."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import FastAPI, Query
from fastapi.responses import HTMLResponse

from abbe.service.domain.people import Permission
from abbe.service.domain.results import SolutionRecord
from abbe.service.web.frame import current
from abbe.service.web.login.access import needs
from abbe.service.web.pages.budget import budget_screen
from abbe.service.web.pages.context import Number, PageContext, find_or_none
from abbe.service.web.pages.motions import motions_screen
from abbe.service.web.pages.results import solution_lines
from abbe.service.web.pages.runs import compare_screen
from abbe.service.web.pages.volume import NODES, VolumeQuery, volume_screen
from abbe.service.web.pages.whatif import whatif_screen

LARGEST = 2**31 - 1
Names = Annotated[list[Annotated[str, Query(max_length=12)]], Query(max_length=30)]
Runs = Annotated[list[Annotated[int, Query(ge=1, le=LARGEST)]], Query(max_length=20)]
Plane = Literal["XY", "XZ", "YZ"]


def add_result_pages(app: FastAPI, context: PageContext) -> None:
    """Add the screens of volume map, what-if, budget and comparison of runs to the application."""
    _add_motions(app, context)
    _add_volume(app, context)
    _add_whatif(app, context)
    _add_budget(app, context)
    _add_compare(app, context)


async def _solution(context: PageContext, number: int | None) -> SolutionRecord | HTMLResponse | None:
    """Return the requested or the newest solution; None if the store has none; a response if the requested solution does not exist."""
    if number is None:
        newest = await context.read(solution_lines, context.store, 1)
        if not newest:
            return None
        number = newest[0].id
    record = await context.read(find_or_none, context.store.solutions.get, number)
    return record if record is not None else await context.missing("solution", number)


def _add_motions(app: FastAPI, context: PageContext) -> None:
    @app.get("/motions", include_in_schema=False)
    @needs(Permission.READ)
    async def motions(id: Number = None, motion: Annotated[str, Query(max_length=12)] = "") -> HTMLResponse:
        record = await _solution(context, id)
        if isinstance(record, HTMLResponse):
            return record
        screen = None if record is None else await context.read(motions_screen, context.store, record, motion)
        return await context.show("motions.html", screen=screen, words={"plot.value": current().translate("plot.value")})


def _add_volume(app: FastAPI, context: PageContext) -> None:
    @app.get("/volume", include_in_schema=False)
    @needs(Permission.READ)
    async def volume(
        id: Number = None,
        motion: Names = [],  # noqa: B006 - FastAPI copies it
        plane: Plane = "XY",
        at: Annotated[int, Query(ge=-1, le=99)] = -1,
        nodes: Annotated[int, Query(ge=NODES[0], le=NODES[-1])] = NODES[-1],
    ) -> HTMLResponse:
        record = await _solution(context, id)
        if isinstance(record, HTMLResponse):
            return record
        query = VolumeQuery(tuple(motion), plane, at, nodes)
        screen = None if record is None else await context.read(volume_screen, context.store, record, query, current().translate)
        return await context.show("volume.html", screen=screen, counts=NODES)


def _add_whatif(app: FastAPI, context: PageContext) -> None:
    @app.get("/whatif", include_in_schema=False)
    @needs(Permission.READ)
    async def whatif(id: Number = None, take: Names = [], everything: bool = False) -> HTMLResponse:  # noqa: B006
        record = await _solution(context, id)
        if isinstance(record, HTMLResponse):
            return record
        screen = None if record is None else await context.read(whatif_screen, context.store, record, take, everything, current().translate)
        return await context.show("whatif.html", 409 if screen is not None and screen.trouble else 200, screen=screen)


def _add_budget(app: FastAPI, context: PageContext) -> None:
    @app.get("/budget", include_in_schema=False)
    @needs(Permission.READ)
    async def budget(id: Number = None) -> HTMLResponse:
        record = await _solution(context, id)
        if isinstance(record, HTMLResponse):
            return record
        screen = None if record is None else await context.read(budget_screen, context.store, record, current().translate)
        return await context.show("budget.html", screen=screen)


def _add_compare(app: FastAPI, context: PageContext) -> None:
    @app.get("/compare", include_in_schema=False)
    @needs(Permission.READ)
    async def compare(run: Runs = []) -> HTMLResponse:  # noqa: B006
        screen = await context.read(compare_screen, context.store, run, current().translate, context.rules)
        return await context.show("compare.html", 409 if screen.trouble else 200, screen=screen)
