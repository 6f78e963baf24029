"""The OpenAPI document, made complete: who may ask, and every status that can be answered, for every route alike."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from starlette.datastructures import MutableHeaders
from starlette.routing import BaseRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from abbe.service.web.catalogue import HTTP
from abbe.service.web.login.access import MUTATING, PUBLIC, Need, cells
from abbe.service.web.login.authentication import COOKIE
from abbe.service.web.problems import MEDIA_TYPE
from abbe.service.web.schemas import Problem

# Security headers on every response, errors included. Pure ASGI: a middleware that wraps requests in tasks breaks cancellation.


HEADERS = {
    "Content-Security-Policy": "default-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'; object-src 'none'",
    "X-Content-Type-Options": "nosniff",
    # Not "no-referrer": with it browsers send "Origin: null" along with our own login form, and nobody can log in.
    "Referrer-Policy": "same-origin",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
KEPT = ("/static/", "/icon.svg")
"""What is the same for everybody: browsers may keep it, and ask whether it is still the same. Nothing else is kept anywhere."""
HSTS = "max-age=31536000"
"""A year; only ever sent over TLS, and of no effect for a page that is asked for by address instead of by name."""


class SecurityHeaders:
    """Adds `HEADERS` to whatever the application answers, how long it may be kept, and that TLS is here to stay.

    Parameters
    ----------
    app : ASGI application
        What answers.
    behind_tls : bool
        A reverse proxy takes the TLS off.
    """

    def __init__(self, app: ASGIApp, *, behind_tls: bool = False) -> None:
        self._app, self._behind_tls = app, behind_tls

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, and put the headers on the answer."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers[name] = value
                headers["Cache-Control"] = "no-cache" if scope["path"].startswith(KEPT) else "no-store"
                if self._behind_tls or scope.get("scheme") == "https":
                    headers["Strict-Transport-Security"] = HSTS
            await send(message)

        await self._app(scope, receive, with_headers)


Doc = dict[str, Any]
REF = {"$ref": "#/components/schemas/Problem"}
UNUSED = ("HTTPValidationError", "ValidationError")
"""What FastAPI declares for 422; no route answers it."""


def complete(document: Doc, routes: Sequence[BaseRoute]) -> Doc:
    """Add to an OpenAPI document, in place, what stands in front of all routes; may be done again.

    Parameters
    ----------
    document : dict
        As FastAPI makes it from the routes.
    routes : sequence of routes
        Of the application.
    """
    wanted = {(path, method.lower()): need for method, path, need in cells(routes)}
    for path, methods in document.get("paths", {}).items():
        for method, operation in methods.items():
            need = wanted.get((path, method))
            _who(operation, need)
            _answers(operation, need, changes=method.upper() in MUTATING)
    schemas = document.setdefault("components", {}).setdefault("schemas", {})
    for name in UNUSED:
        schemas.pop(name, None)
    schemas["Problem"] = Problem.model_json_schema()
    document["components"]["securitySchemes"] = {
        "token": {"type": "http", "scheme": "bearer", "description": "abbe user token new"},
        "session": {"type": "apiKey", "in": "cookie", "name": COOKIE, "description": "of POST /login; changes need X-CSRF-Token too"},
    }
    return document


def _who(operation: Doc, need: Need | None) -> None:
    if need is PUBLIC or need is None:
        return
    operation["security"] = [{"token": []}, {"session": []}]
    operation["x-permission"] = need.value


def _answers(operation: Doc, need: Need | None, *, changes: bool) -> None:
    given = {p["in"] for p in operation.get("parameters", [])}
    statuses = {400, 429, 500, 503}
    if need is not PUBLIC:
        statuses |= {401, 403}
    if given or changes:
        statuses.add(422)
    if "path" in given:
        statuses |= {404, 409}
    if changes:
        statuses |= {409, 413}
    answers: Doc = operation.setdefault("responses", {})
    for status in sorted(statuses):
        answers.setdefault(str(status), {"description": HTTP[status][1]})
    for name, answer in answers.items():
        if name >= "400":
            answer["description"] = HTTP[422][1] if name == "422" else answer["description"]
            answer["content"] = {MEDIA_TYPE: {"schema": REF}}
    # In front of the application, and answered in words: a Host that is not ours, too much at once.
    for name in ("400", "503"):
        answers[name]["content"]["text/plain"] = {"schema": {"type": "string"}}
    if need is not PUBLIC and not changes:
        answers.setdefault("303", {"description": "Nobody is logged in, and a browser asks for text/html: to the login page"})
