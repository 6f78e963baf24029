"""The live run: what is measured now, and the buttons that hold and end it. Everything that moves is drawn by ``static/live.js``."""

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

SCRIPT_WORDS = (
    "live.abort", "live.ended", "live.gone", "live.old", "live.pause", "live.resume", "live.stop", "live.no_path",
    "live.of", "live.share_here",
)  # fmt: skip
"""What the script fills in; the states of a measurement, and how one ends, come on top."""


def add_live_page(app: FastAPI, context: PageContext, jobs: Callable[[], Sequence[JobState]] = tuple) -> None:
    """Add the screen to the application. ``jobs``: those since the service began, newest first; the screen shows how the last one ended."""

    @app.get("/live", include_in_schema=False)
    @needs(Permission.READ)
    async def live() -> HTMLResponse:
        status = await context.source.status()
        return await context.show(
            "live.html",
            moment=status,
            last=next((job for job in jobs() if job.ended_utc is not None), None),
            may_measure=current().may(Permission.MEASURE) and bool(current().csrf),
            words=script_words(current().lang),
            due_words=lambda one: language.due(current().lang, one.due_utc, status.now_utc),
        )


def script_words(lang: str) -> dict[str, str]:
    """The texts that the script needs, by key."""
    told = language.catalogue(lang)
    states = {key: text for key, text in told.items() if key.startswith(("measuring.", "slot."))}
    return {key: told[key] for key in SCRIPT_WORDS} | states
