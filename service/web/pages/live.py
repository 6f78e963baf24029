"""The screen of the running measurement with its buttons. ``static/live.js`` draws everything that changes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from fastapi import FastAPI
from fastapi.responses import HTMLResponse

from abbe.service.domain.job_state import JobState
from abbe.service.users.roles import Permission
from abbe.service.web import language
from abbe.service.web.frame import current
from abbe.service.web.login.access import needs
from abbe.service.web.pages.context import PageContext

SCRIPT_KEYS = (
    "live.abort", "live.ended", "live.gone", "live.old", "live.pause", "live.resume", "live.stop", "live.no_path",
    "live.of", "live.share_here",
)  # fmt: skip
"""Texts for the script, besides the states and outcomes of a measurement."""


def add_live_page(app: FastAPI, context: PageContext, jobs: Callable[[], Sequence[JobState]] = tuple) -> None:
    """Add the screen to the application. ``jobs``: jobs since the start of the service, newest first, for the outcome of the last one."""

    @app.get("/live", include_in_schema=False)
    @needs(Permission.READ)
    async def live() -> HTMLResponse:
        status = await context.source.status()
        return await context.show(
            "live.html",
            status=status,
            last=next((job for job in jobs() if job.ended_utc is not None), None),
            may_measure=current().may(Permission.MEASURE) and bool(current().csrf),
            texts=script_texts(current().lang),
            due_words=lambda one: language.due(current().lang, one.due_utc, status.now_utc),
        )


def script_texts(lang: str) -> dict[str, str]:
    """The texts for the script, by key."""
    texts = language.catalogue(lang)
    states = {key: text for key, text in texts.items() if key.startswith(("measuring.", "slot."))}
    return {key: texts[key] for key in SCRIPT_KEYS} | states
