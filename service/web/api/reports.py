"""Route: reports to sign, from stored data without a new computation. Each runs in a thread, `AT_A_TIME` at once."""

from __future__ import annotations

import asyncio
from enum import StrEnum
from typing import Annotated, Any

from fastapi import FastAPI, Query
from fastapi.responses import Response

from abbe.service.errors import NotStored
from abbe.service.queries.reader import as_stored, storable
from abbe.service.rendering.document import Document
from abbe.service.rendering.document_page import FORMS, default_name
from abbe.service.report.report import numbered_report, stored_report
from abbe.service.users.roles import Permission
from abbe.service.web.api.sources import Number, Sources
from abbe.service.web.login.access import needs

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
        "description": "The report, as a file to be saved; the same data give the same bytes",
        "content": {
            "application/pdf": {"schema": {"type": "string", "format": "binary"}},
            "text/html": {"schema": {"type": "string"}},
            "text/csv": {"schema": {"type": "string"}},
            "application/json": {"schema": {"type": "object"}},
        },
    }
}


def add_reports(app: FastAPI, sources: Sources) -> None:
    """Add the route."""
    few = asyncio.Semaphore(AT_A_TIME)

    @app.get("/api/v1/reports/{kind}/{number}", response_class=Response, responses=WRITTEN)
    @needs(Permission.READ)
    async def report(
        kind: ReportKind,
        number: Number,
        form: Annotated[ReportForm, Query(description="File format.")] = ReportForm.PDF,
        machine: Annotated[str | None, Query(description="Machine of the push, if the store has several.")] = None,
    ) -> Response:
        """A report to sign: figures with U by ISO 230, conditions, decision, unobservable quantities."""
        async with few:
            name, data = await asyncio.to_thread(_written, sources, kind, number, form, machine)
        return Response(data, media_type=MEDIA[form], headers={"Content-Disposition": f'attachment; filename="{name}"'})


def _written(sources: Sources, kind: ReportKind, number: int, form: ReportForm, machine: str | None) -> tuple[str, bytes]:
    with as_stored():
        document = _document(sources, kind, number, machine)
        found = FORMS[f".{form}"](document)
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
    row = reader.row(listing, number, kind)
    if kind is ReportKind.RUN:
        return stored_report(store, store.runs.find(f"{row['campaign']}/{row['label']}"), sources.rules)
    if kind is ReportKind.CAMPAIGN:
        return stored_report(store, store.campaigns.find(row["name"]), sources.rules)
    return numbered_report(store, kind, number, sources.rules)
