"""The screen of the table in force: which it is by the push journal, how it came there, what was pushed, and the order back."""

from __future__ import annotations

import secrets

from fastapi import FastAPI
from fastapi.responses import HTMLResponse

from abbe.service.errors import JournalChanged
from abbe.service.queries.pushes import tables
from abbe.service.users.roles import Permission
from abbe.service.web.frame import current
from abbe.service.web.login.access import needs
from abbe.service.web.pages.context import PageContext

MOST = 50
SIGNS = {"kept": "ok", "rolled back": "bad", "refused": "bad", "failed": "bad", "open": "bad"}
ENDS = ("kept", "rolled back", "refused", "failed", "stopped", "open", "interrupted")
"""How an order of a table ends."""


def ends(group: str) -> dict[str, str]:
    """The words of these ends for a reader, from a group of the catalogue."""
    return {word: current().state(group, word) for word in ENDS}


def add_table_screen(app: FastAPI, context: PageContext) -> None:
    """Add the screen to the application."""

    @app.get("/table", include_in_schema=False)
    @needs(Permission.READ)
    async def table() -> HTMLResponse:
        try:
            told = await context.read(tables, context.reader)
        except JournalChanged as error:
            return await context.show("table.html", 409, broken=error.detail, told=None)
        status = await context.source.status()
        return await context.show(
            "table.html",
            told=told,
            broken="",
            pushes=told.pushes[:MOST],
            attention=status.attention,
            verified=status.verified,
            job=status.job,
            may_order=current().may(Permission.APPROVE) and bool(current().csrf),
            key=secrets.token_hex(8),
            words=ends("table.back_word"),
            sign=lambda word: SIGNS.get(word, "open"),
            crc=lambda number: f"{number:08X}",
        )
