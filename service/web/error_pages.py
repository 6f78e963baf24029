"""Errors as screens for people; programs get the problem documents of `abbe.service.web.problems`.

While the core is silent, people get a screen that says so: old values are never shown as current.
"""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable
from contextlib import suppress

from fastapi import FastAPI, Request
from fastapi.responses import HTMLResponse, Response
from jinja2 import Environment
from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from abbe.service.domain.document import Doc
from abbe.service.domain.people import Permission
from abbe.service.errors import CoreUnavailable
from abbe.service.queries.status import Status
from abbe.service.web.frame import current, frame_for
from abbe.service.web.problems import MEDIA_TYPE, problem, problem_of
from abbe.service.web.strip import strip_of

RETRY_S = "5"


def add_core_unavailable(app: FastAPI, env: Environment) -> None:
    """Install the handler of `CoreUnavailable` for every address."""

    async def silent(request: Request, error: Exception) -> Response:
        assert isinstance(error, CoreUnavailable)
        if not for_people(request):
            return problem_of(error)
        return HTMLResponse(
            env.get_template("core_unavailable.html").render(texts=filter(None, (error.detail, error.remedy)), bar=strip_of(None)),
            503,
            {"Retry-After": RETRY_S},
        )

    app.add_exception_handler(CoreUnavailable, silent)


def for_people(request: Request) -> bool:
    """Whether the request is for a screen. The home page always is: its script fetches it without an Accept header."""
    path = request.url.path
    return path == "/" or "text/html" in request.headers.get("accept", "")


class ErrorPages:
    """Shows a problem document to people as a screen: a browser's address bar never shows JSON, whichever layer refuses the request.

    Pure ASGI, around all layers that can refuse a request. ``status``: source of the status bar.
    """

    def __init__(self, app: ASGIApp, env: Environment, status: Callable[[], Awaitable[Status]]) -> None:
        self._app, self._env, self._status = app, env, status

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on; replace a problem document by a screen."""
        if scope["type"] != "http" or not _reads_html(scope):
            await self._app(scope, receive, send)
            return
        start: list[Message] = []
        body: list[bytes] = []

        async def replaced(message: Message) -> None:
            if message["type"] == "http.response.start" and message["status"] >= 400 and not _is_screen(message):
                start.append(message)
            elif not start:
                await send(message)
            else:
                body.append(message.get("body", b""))
                if not message.get("more_body", False):
                    await self._page(scope, start[0], _problem_in(start[0], b"".join(body)))(scope, receive, send)

        await self._app(scope, receive, replaced)

    def _page(self, scope: Scope, start: Message, told: Doc) -> ASGIApp:
        kept = {k.decode(): v.decode() for k, v in start["headers"] if k not in {b"content-type", b"content-length"}}

        async def answer(_: Scope, receive: Receive, send: Send) -> None:
            request, now = HTTPConnection(scope), None
            with frame_for(request):
                if current().may(Permission.READ):
                    with suppress(Exception):  # whatever is broken: the screen with the first error is shown
                        now = await self._status()
                page = self._env.get_template("error.html").render(problem=told, bar=strip_of(now))
            await HTMLResponse(page, int(start["status"]), kept)(scope, receive, send)

        return answer


def _is_screen(start: Message) -> bool:
    return any(name == b"content-type" and value.startswith(b"text/html") for name, value in start["headers"])


def _problem_in(start: Message, body: bytes) -> Doc:
    """The problem document of a response; if a lower layer has answered with text, a problem document with this text."""
    given = dict(start["headers"]).get(b"content-type", b"") == MEDIA_TYPE.encode()
    text = bytes(body if given else problem(int(start["status"]), body.decode("utf-8", "replace")).body)
    found: Doc = json.loads(text)
    return found


def _reads_html(scope: Scope) -> bool:
    return any(name == b"accept" and b"text/html" in value for name, value in scope["headers"])
