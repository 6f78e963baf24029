"""Routes: solutions with the map of their volume, discoveries, checks and their trends; reports of all of them."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from datetime import UTC, datetime
from enum import StrEnum
from typing import Annotated, Any, Literal

from fastapi import FastAPI, Query
from fastapi.responses import Response
from pydantic import BeforeValidator

from abbe.service.domain.people import Permission
from abbe.service.domain.verification import Verification
from abbe.service.errors import NotStored
from abbe.service.queries import checks as check_queries
from abbe.service.queries import results
from abbe.service.queries.reader import as_stored, storable
from abbe.service.rendering.document import Document
from abbe.service.rendering.document_page import FORMS, default_name
from abbe.service.report.report import certified, numbered_report, stored_report
from abbe.service.web.api.sources import Cursor, Filter, Limit, Number, Sources
from abbe.service.web.frame import current
from abbe.service.web.login.access import needs
from abbe.service.web.schemas import CheckList, DiscoveryList, SolutionList

MOST_NODES = 9
Nodes = Annotated[int, Query(ge=2, le=MOST_NODES, description="Nodes per axis.")]
Motion = Literal[
    "EXX", "EYX", "EZX", "EAX", "EBX", "ECX", "EXY", "EYY", "EZY", "EAY", "EBY", "ECY",
    "EXZ", "EYZ", "EZZ", "EAZ", "EBZ", "ECZ", "C0Y", "B0Z", "A0Z",
]  # fmt: skip
Motions = Annotated[list[Motion], Query(max_length=21, description="Motions whose joint effect the map shows; none given: all motions.")]


def _no_number(value: object) -> object:
    """Refuse a time given as a number of seconds: a person cannot check it by eye."""
    try:
        float(str(value))
    except ValueError:
        return value
    raise ValueError("expected a date and time, e.g. 2026-11-21T03:00:00Z")


UtcTime = Annotated[datetime, BeforeValidator(_no_number)]
After = Annotated[
    UtcTime | None, Query(description="Only checks after this time (UTC if it has no offset); absent: since the table came into force.")
]


def add_results(app: FastAPI, sources: Sources) -> None:
    """Add the routes of solutions, discoveries, checks and trends to the application."""
    _add_solutions(app, sources)
    _add_discoveries(app, sources)
    _add_checks(app, sources)


def _add_solutions(app: FastAPI, sources: Sources) -> None:
    @app.get("/api/v1/solutions")
    @needs(Permission.READ)
    def solutions(campaign: Filter = None, machine: Filter = None, cursor: Cursor = None, limit: Limit = 50) -> SolutionList:
        """Solutions, newest first."""
        found, after = results.solutions(sources.reader, campaign, machine, cursor, limit)
        return SolutionList(solutions=found, next_cursor=after)

    @app.get("/api/v1/solutions/{number}")
    @needs(Permission.READ)
    def solution(number: Number) -> results.SolutionDetail:
        """A solution: parameters with uncertainties, unobservable quantities, residuals, budget."""
        return results.solution(sources.reader, number)

    @app.get("/api/v1/solutions/{number}/field")
    @needs(Permission.READ)
    def field(number: Number, motion: Motions = [], nodes: Nodes = 6) -> results.VolumeMap:  # noqa: B006 - FastAPI copies it
        """The volume map: deviation and uncertainty at the nodes, from the full covariance of the solution."""
        return results.volume_map(sources.reader, number, motion, nodes)


def _add_discoveries(app: FastAPI, sources: Sources) -> None:
    @app.get("/api/v1/discoveries")
    @needs(Permission.READ)
    def discoveries(campaign: Filter = None, machine: Filter = None, cursor: Cursor = None, limit: Limit = 50) -> DiscoveryList:
        """Searches for missing effects, newest first."""
        found, after = results.discoveries(sources.reader, campaign, machine, cursor, limit)
        return DiscoveryList(discoveries=found, next_cursor=after)

    @app.get("/api/v1/discoveries/{number}")
    @needs(Permission.READ)
    def discovery(number: Number) -> results.DiscoveryDetail:
        """A search for missing effects, with its states and its result."""
        return results.discovery(sources.reader, number)


def _add_checks(app: FastAPI, sources: Sources) -> None:
    @app.get("/api/v1/checks")
    @needs(Permission.READ)
    def checks(machine: Filter = None, verdict: Filter = None, cursor: Cursor = None, limit: Limit = 50) -> CheckList:
        """Checks of all machines of the store, newest first."""
        found, after = check_queries.checks(sources.reader, machine, verdict, cursor, limit)
        return CheckList(verifications=found, next_cursor=after)

    @app.get("/api/v1/checks/{number}")
    @needs(Permission.READ)
    def check(number: Number) -> Verification:
        """One check: figures with uncertainties (k = 2), limits, verdict."""
        return check_queries.check(sources.reader, number)

    @app.get("/api/v1/trends")
    @needs(Permission.READ)
    def trends(
        machine: Annotated[str | None, Query(description="Name of a machine; absent: the machine of this service.")] = None,
        after: After = None,
    ) -> check_queries.Trends:
        """Whether the figures of the checks drift, since when, and when they reach their limits."""
        since = after.replace(tzinfo=UTC) if after is not None and after.tzinfo is None else after
        return check_queries.trends(sources.reader, sources.reader.machine if machine is None else machine, since)


AT_A_TIME = 2


class ReportKind(StrEnum):
    """Subject of a report."""

    RUN = "run"
    CAMPAIGN = "campaign"
    VERIFICATION = "verification"
    DISCOVERY = "discovery"
    PUSH = "push"


class ReportForm(StrEnum):
    """File format of a report."""

    PDF = "pdf"
    HTML = "html"
    CSV = "csv"
    JSON = "json"


MEDIA = {ReportForm.PDF: "application/pdf", ReportForm.HTML: "text/html", ReportForm.CSV: "text/csv", ReportForm.JSON: "application/json"}
WRITTEN: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The report, as a file to be saved; the same data and language give the same bytes",
        "content": {
            "application/pdf": {"schema": {"type": "string", "format": "binary"}},
            "text/html": {"schema": {"type": "string"}},
            "text/csv": {"schema": {"type": "string"}},
            "application/json": {"schema": {"type": "object"}},
        },
    }
}


def add_reports(app: FastAPI, sources: Sources) -> None:
    """Add the route of the reports to the application."""
    few = asyncio.Semaphore(AT_A_TIME)

    @app.get("/api/v1/reports/{kind}/{number}", response_class=Response, responses=WRITTEN)
    @needs(Permission.READ)
    async def report(
        kind: ReportKind,
        number: Number,
        form: Annotated[ReportForm, Query(description="File format.")] = ReportForm.PDF,
        machine: Annotated[str | None, Query(description="Machine of the push, if the store has several.")] = None,
    ) -> Response:
        """A report to sign: figures with U by ISO 230, conditions, decision, unobservable quantities.

        PDF and HTML are in the reader's language.
        """
        async with few:
            name, data = await asyncio.to_thread(_written, sources, kind, number, form, machine, current().lang)
        return Response(data, media_type=MEDIA[form], headers={"Content-Disposition": f'attachment; filename="{name}"'})


def _written(sources: Sources, kind: ReportKind, number: int, form: ReportForm, machine: str | None, lang: str) -> tuple[str, bytes]:
    with as_stored():
        document = certified(_document(sources, kind, number, machine), sources.rules, None, sources.reader.clock.utc().date())
        found = FORMS[f".{form}"](replace(document, lang=lang))
    name = default_name(document).removesuffix(".pdf") + f".{form}"
    return name, found.encode() if isinstance(found, str) else found


def _document(sources: Sources, kind: ReportKind, number: int, machine: str | None) -> Document:
    reader, store = sources.reader, sources.reader.store
    if kind is ReportKind.PUSH:
        if machine is not None and (not storable(machine) or not store.pushes.entries(machine, reader.control_of(machine))):
            raise NotStored("this machine has no push")
        found = store.pages.page(
            "pushes", {"push": number, "machine": machine and store.pushes.chain(machine, reader.control_of(machine))}, None, 1
        )
        if not found:
            raise NotStored(f"there is no push {number}")
        return numbered_report(store, kind, number, sources.rules, machine)
    listing = {
        ReportKind.RUN: "runs",
        ReportKind.CAMPAIGN: "campaigns",
        ReportKind.VERIFICATION: "verifications",
        ReportKind.DISCOVERY: "discoveries",
    }[kind]
    reader.row(listing, number, kind)
    if kind is ReportKind.RUN:
        return stored_report(store, store.runs.find(number), sources.rules)
    if kind is ReportKind.CAMPAIGN:
        return stored_report(store, store.campaigns.find(number), sources.rules)
    return numbered_report(store, kind, number, sources.rules)
