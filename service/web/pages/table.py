"""The screen of the table in force by the push journal: its origin, the pushes, and the rollback."""

from __future__ import annotations

import secrets

from fastapi import FastAPI
from fastapi.responses import HTMLResponse

from abbe.service.errors import JournalChanged
from abbe.service.queries.tables import tables
from abbe.service.users.roles import Permission
from abbe.service.web.frame import current
from abbe.service.web.login.access import needs
from abbe.service.web.pages.context import PageContext

MOST = 50
SIGNS = {"kept": "ok", "rolled back": "bad", "refused": "bad", "failed": "bad", "open": "bad"}
OUTCOMES = ("kept", "rolled back", "refused", "failed", "stopped", "open", "interrupted")
"""Outcomes of a push or rollback."""


def outcome_texts(group: str) -> dict[str, str]:
    """Texts of the outcomes in the reader's language, from a group of the catalogue."""
    return {outcome: current().state(group, outcome) for outcome in OUTCOMES}


def add_table_screen(app: FastAPI, context: PageContext) -> None:
    """Add the screen to the application."""

    @app.get("/table", include_in_schema=False)
    @needs(Permission.READ)
    async def table() -> HTMLResponse:
        try:
            history = await context.read(tables, context.reader)
        except JournalChanged as error:
            return await context.show("table.html", 409, broken=error.detail, history=None)
        status = await context.source.status()
        return await context.show(
            "table.html",
            history=history,
            broken="",
            pushes=history.pushes[:MOST],
            attention=status.attention,
            verified=status.verified,
            job=status.job,
            may_order=current().may(Permission.APPROVE) and bool(current().csrf),
            key=secrets.token_hex(8),
            texts=outcome_texts("table.back_word"),
            sign=lambda word: SIGNS.get(word, "open"),
            crc=lambda number: f"{number:08X}",
        )
