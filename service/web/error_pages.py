"""Errors as screens for people; programs get the problem documents of `abbe.service.web.problems`.

While the core is silent, people get a screen that says so: old values are never shown as current.
"""

from __future__ import annotations

from fastapi import FastAPI, Request
from fastapi.responses import HTMLResponse, Response
from jinja2 import Environment

from abbe.service.errors import CoreSilent
from abbe.service.web.problems import problem_of
from abbe.service.web.strip import strip_of

RETRY_S = "5"


def add_core_unavailable(app: FastAPI, env: Environment) -> None:
    """Install the handler of `CoreSilent` for every address."""

    async def silent(request: Request, error: Exception) -> Response:
        assert isinstance(error, CoreSilent)
        if not for_people(request):
            return problem_of(error)
        return HTMLResponse(
            env.get_template("core_unavailable.html").render(text=str(error), bar=strip_of(None)), 503, {"Retry-After": RETRY_S}
        )

    app.add_exception_handler(CoreSilent, silent)


def for_people(request: Request) -> bool:
    """Whether the request is for a screen. The home page always is: its script fetches it without an Accept header."""
    path = request.url.path
    return path == "/" or (not path.startswith("/api/") and "text/html" in request.headers.get("accept", ""))
