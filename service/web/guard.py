"""In front of every route: rate, who asks, what the route needs, where the request comes from; behind it: the record. Pure ASGI."""

from __future__ import annotations

import hmac
from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import urlsplit

from starlette.requests import HTTPConnection
from starlette.responses import RedirectResponse, Response
from starlette.routing import BaseRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.audit.chain import Event
from service.errors import AbbeError
from service.users.people import NOBODY, ONLOOKER, Principal
from service.web.access import MUTATING, PUBLIC, Need, need_of, route_of
from service.web.door import COOKIE, SECURE_COOKIE, Door, csrf_token
from service.web.problems import problem

CSRF_HEADER = "X-CSRF-Token"


@dataclass
class Visit:
    """What is known of a request; handlers find it in ``request.state.visit``. ``target``, ``who``: for the record, if they know better."""

    principal: Principal
    address: str
    secret: str = ""
    target: str = ""
    who: str = ""


class Guard:
    """Lets through what is allowed.

    Parameters
    ----------
    app : ASGI application
        Behind it.
    routes : sequence of routes
        Of the application, as they are at the time of a request.
    door : Door, optional
        Without one there are no users: everybody is an onlooker, and nothing can be changed.
    """

    def __init__(self, app: ASGIApp, routes: Sequence[BaseRoute], door: Door | None) -> None:
        self._app, self._routes, self._door = app, routes, door

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let pass, or answer."""
        if scope["type"] not in {"http", "websocket"}:
            await self._app(scope, receive, send)
            return
        request = HTTPConnection(scope)
        address = request.client.host if request.client else ""
        if self._door is not None and not self._door.requests.take(address):
            await _answer(problem(429, "too many requests from this address", headers={"Retry-After": "1"}), scope, receive, send)
            return
        route = route_of(self._routes, scope)
        if route is None:  # the router says what is not there, and what is there by another method
            await self._app(scope, receive, send)
            return
        visit = Visit(NOBODY, address)
        scope.setdefault("state", {})["visit"] = visit
        changes = scope["type"] == "http" and scope["method"] in MUTATING
        try:
            refused = await self._refusal(request, need_of(route), visit, changes=changes)
        except AbbeError as error:  # the store does not answer: then nobody is known
            refused = problem(503, error.detail, error.code, {"Retry-After": "5"})
        if changes and self._door is not None:
            await self._recorded(self._door, route, visit, refused, (scope, receive, send))
        elif refused is not None:
            await _answer(refused, scope, receive, send)
        else:
            await self._app(scope, receive, send)

    async def _refusal(self, request: HTTPConnection, need: Need | None, visit: Visit, *, changes: bool) -> Response | None:
        """Why a request is not let through; None: it is."""
        if need is None:
            return problem(403, "nobody has said who may do this")
        bearer = _bearer(request)
        secret = request.cookies.get(SECURE_COOKIE if _is_tls(request) else COOKIE)
        if need is not PUBLIC or (changes and secret):
            visit.principal = ONLOOKER if self._door is None else await self._door.who(bearer, secret)
        visit.secret = (secret or "") if visit.principal.by == "session" else ""
        if need is not PUBLIC and (missing := _missing(request, need, visit.principal, changes=changes)) is not None:
            return missing
        if changes or request.scope["type"] == "websocket":
            return _foreign(request, visit, need, changes=changes)
        return None

    async def _recorded(
        self, door: Door, route: BaseRoute, visit: Visit, refused: Response | None, call: tuple[Scope, Receive, Send]
    ) -> None:
        """Answer, with a record of it on disk before the answer leaves; without one the answer is that something is wrong."""
        scope, receive, send = call
        action, unrecorded = f"{scope['method']} {getattr(route, 'path', '')}", False

        async def record_first(message: Message) -> None:
            nonlocal unrecorded
            if message["type"] == "http.response.start":
                try:
                    await self._record(door, action, visit, scope["path"], int(message["status"]))
                except AbbeError as error:
                    unrecorded = True
                    await problem(503, error.detail, error.code, {"Retry-After": "5"})(scope, receive, send)
            if not unrecorded:
                await send(message)

        if refused is not None:
            await _answer(refused, scope, receive, record_first)
        else:
            await self._app(scope, receive, record_first)

    async def _record(self, door: Door, action: str, visit: Visit, path: str, status: int) -> None:
        if status == 429 or (status >= 400 and not door.noise.take(visit.address)):
            return
        outcome = f"done {status}" if status < 400 else f"refused {status}"
        await door.record(Event(visit.who or visit.principal.name, action, visit.target or path, outcome, {"address": visit.address}))


def _missing(request: HTTPConnection, need: Need, principal: Principal, *, changes: bool) -> Response | None:
    # Without users everybody may look; to change something one has to be somebody.
    if principal is NOBODY or (changes and principal.by == "nobody"):
        if "text/html" in request.headers.get("accept", "") and not changes and request.scope["type"] == "http":
            return RedirectResponse("/login", 303)
        return problem(401, "log in, or send a token", headers={"WWW-Authenticate": "Bearer"})
    if need not in principal.permissions:
        return problem(403, f"a {principal.role} may not do this: it needs {need.value!r}")
    return None


def _foreign(request: HTTPConnection, visit: Visit, need: Need, *, changes: bool) -> Response | None:
    """Whether another site's page sends this. A browser always says where from; a program with a token has no cookie to be misused."""
    origin = request.headers.get("origin")
    by_token = visit.principal.by == "token"
    if not (origin is None and by_token) and not _is_ours(request, origin):
        return problem(403, "this came from another page than ours (Origin)")
    if changes and need is not PUBLIC and not by_token:
        sent = request.headers.get(CSRF_HEADER, "")
        if not hmac.compare_digest(sent.encode(), csrf_token(visit.secret).encode()):
            return problem(403, f"the header {CSRF_HEADER} is missing or not of this session")
    return None


def _is_ours(request: HTTPConnection, origin: str | None) -> bool:
    if request.headers.get("sec-fetch-site", "same-origin") not in {"same-origin", "none"}:
        return False
    try:
        parts = urlsplit(origin or "")
    except ValueError:
        return False
    schemes = {"https"} if _is_tls(request) else {"http", "https"}  # a reverse proxy may have taken the TLS off
    return parts.scheme in schemes and bool(parts.netloc) and parts.netloc.lower() == request.headers.get("host", "").lower()


def _is_tls(request: HTTPConnection) -> bool:
    return request.scope.get("scheme") in {"https", "wss"}


def _bearer(request: HTTPConnection) -> str | None:
    kind, _, text = request.headers.get("authorization", "").partition(" ")
    return text.strip() if kind.lower() == "bearer" else None


async def _answer(response: Response, scope: Scope, receive: Receive, send: Send) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008})
        return
    await response(scope, receive, send)
