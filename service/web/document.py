"""Security headers, and the OpenAPI document completed with permissions and with all statuses of every route."""

from __future__ import annotations

from collections.abc import Sequence

from starlette.datastructures import MutableHeaders
from starlette.routing import BaseRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from abbe.service.domain.document import Doc
from abbe.service.web.catalogue import HTTP
from abbe.service.web.login.access import MUTATING, PUBLIC, Need, route_permissions
from abbe.service.web.login.authentication import COOKIE
from abbe.service.web.problems import MEDIA_TYPE
from abbe.service.web.schemas import Problem

HEADERS = {
    "Content-Security-Policy": "default-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'; object-src 'none'",
    "X-Content-Type-Options": "nosniff",
    # Not "no-referrer": browsers would send "Origin: null" with our own login form, and every login would fail.
    "Referrer-Policy": "same-origin",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
KEPT = ("/static/", "/icon.svg", "/sw.js", "/manifest.webmanifest")
"""Content that is the same for all visitors: browsers may cache and revalidate it. They cache nothing else."""
HSTS = "max-age=31536000"
"""One year. Sent only over TLS; browsers ignore it for a page requested by address instead of by name."""


class SecurityHeaders:
    """Adds `HEADERS`, Cache-Control and, over TLS, HSTS to every response, errors included.

    Pure ASGI: a middleware that wraps requests in tasks breaks cancellation. ``behind_tls``: a reverse proxy terminates TLS.
    """

    def __init__(self, app: ASGIApp, *, behind_tls: bool = False) -> None:
        self._app, self._behind_tls = app, behind_tls

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on and add the headers to the response."""
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


REF = {"$ref": "#/components/schemas/Problem"}
UNUSED = ("HTTPValidationError", "ValidationError")
"""Schemas that FastAPI declares for 422; no route uses them."""


def complete(document: Doc, routes: Sequence[BaseRoute]) -> Doc:
    """Add the permissions of the routes and the responses of the middleware to FastAPI's OpenAPI document, in place; idempotent."""
    needs = {(path, method.lower()): need for method, path, need in route_permissions(routes)}
    for path, methods in document.get("paths", {}).items():
        for method, operation in methods.items():
            need = needs.get((path, method))
            _who(operation, need)
            _answers(operation, need, changes=method.upper() in MUTATING)
    schemas = document.setdefault("components", {}).setdefault("schemas", {})
    for name in UNUSED:
        schemas.pop(name, None)
    schemas["Problem"] = Problem.model_json_schema()
    document["components"]["securitySchemes"] = {
        "token": {"type": "http", "scheme": "bearer", "description": "abbe user token new"},
        "session": {
            "type": "apiKey",
            "in": "cookie",
            "name": COOKIE,
            "description": "cookie from POST /login; changes need X-CSRF-Token too",
        },
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
    # The server answers a foreign Host and overload in plain text, before the application.
    for name in ("400", "503"):
        answers[name]["content"]["text/plain"] = {"schema": {"type": "string"}}
    if need is not PUBLIC and not changes:
        answers.setdefault("303", {"description": "Without a login, a browser that asks for text/html is redirected to the login page"})
