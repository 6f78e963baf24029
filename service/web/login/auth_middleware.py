"""In front of every route: rate, who asks, how long the body is, what the route needs, where the request comes from; behind it: the record.

Pure ASGI. Nothing of a body is read for somebody unknown.
"""

from __future__ import annotations

import hmac
from collections.abc import Sequence
from dataclasses import dataclass

from starlette.requests import HTTPConnection
from starlette.responses import RedirectResponse, Response
from starlette.routing import BaseRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from abbe.service.domain.audit_event import AuditEvent
from abbe.service.errors import AbbeError
from abbe.service.users.people import NOBODY, ONLOOKER, Principal
from abbe.service.web.bodies import Body
from abbe.service.web.login.access import ACTIVE_HEADER, MUTATING, PUBLIC, Need, in_use, need_of, route_of
from abbe.service.web.login.authentication import Authenticator, csrf_token
from abbe.service.web.login.origin import address_of, is_ours, is_tls
from abbe.service.web.problems import problem

CSRF_HEADER = "X-CSRF-Token"


@dataclass
class Visit:
    """What is known of a request; handlers find it in ``request.state.visit``. ``target``, ``who``: for the record, if they know better.
    ``replayed``: the answer was given before, and nothing was done again."""

    principal: Principal
    address: str
    secret: str = ""
    target: str = ""
    who: str = ""
    replayed: bool = False


class AuthMiddleware:
    """Lets through what is allowed.

    Parameters
    ----------
    app : ASGI application
        Behind it.
    routes : sequence of routes
        Of the application, as they are at the time of a request.
    auth : Authenticator, optional
        Without one there are no users: everybody is an onlooker, and nothing can be changed.
    """

    def __init__(self, app: ASGIApp, routes: Sequence[BaseRoute], auth: Authenticator | None) -> None:
        self._app, self._routes, self._auth = app, routes, auth
        self._behind_tls = auth is not None and auth.behind_tls

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let pass, or answer."""
        if scope["type"] not in {"http", "websocket"}:
            await self._app(scope, receive, send)
            return
        request = HTTPConnection(scope)
        address = address_of(request, behind_tls=self._behind_tls)
        if self._auth is not None and not self._auth.requests.take(address):
            await _answer(problem(429, "too many requests from this address", headers={"Retry-After": "1"}), scope, receive, send)
            return
        route = route_of(self._routes, scope)
        if route is None:  # the router says what is not there, and what is there by another method
            await self._app(scope, receive, send)
            return
        visit = Visit(NOBODY, address)
        scope.setdefault("state", {})["visit"] = visit
        changes = scope["type"] == "http" and scope["method"] in MUTATING
        body = Body(scope, receive, route) if changes else None
        try:
            refused = await self._refusal(request, need_of(route), visit, body)
        except AbbeError as error:  # without the store no visitor can be identified
            refused = problem(503, error.detail, error.code, {"Retry-After": "5"})
        if body is not None and self._auth is not None:
            await self._recorded(self._auth, route, visit, refused, (scope, body.receive, send))
        elif refused is not None:
            await _answer(refused, scope, receive, send)
        else:
            await self._app(scope, receive, send)

    async def _refusal(self, request: HTTPConnection, need: Need | None, visit: Visit, body: Body | None) -> Response | None:
        """Why a request is not let through; None: it is. ``body``: of one that changes something."""
        if need is None:
            return problem(403, "nobody has said who may do this")
        changes = body is not None
        bearer = _bearer(request)
        tls = is_tls(request, behind_tls=self._behind_tls)
        secret = None if self._auth is None else request.cookies.get(self._auth.cookie(tls=tls))
        if need is not PUBLIC or (changes and secret):
            used = changes or in_use(request.url.path, request.headers.get(ACTIVE_HEADER))
            visit.principal = ONLOOKER if self._auth is None else await self._auth.who(bearer, secret, in_use=used)
        visit.secret = (secret or "") if visit.principal.by == "session" else ""
        if need is not PUBLIC and (unknown := _unknown(request, visit.principal, changes=changes)) is not None:
            return unknown
        if body is not None and (too_long := await body.refusal()) is not None:
            return too_long
        if need is not PUBLIC and need not in visit.principal.permissions:
            return problem(403, f"a {visit.principal.role} may not do this: it needs {need.value!r}")
        if changes or request.scope["type"] == "websocket":
            return self._foreign(request, visit, need, changes=changes)
        return None

    def _foreign(self, request: HTTPConnection, visit: Visit, need: Need, *, changes: bool) -> Response | None:
        """Whether another site's page sends this. A browser always says where from; a program with a token has no cookie to be misused."""
        origin = request.headers.get("origin")
        by_token = visit.principal.by == "token"
        if not (origin is None and by_token) and not is_ours(request, origin, behind_tls=self._behind_tls):
            return problem(403, "this came from another page than ours (Origin)")
        if changes and need is not PUBLIC and not by_token:
            sent = request.headers.get(CSRF_HEADER, "")
            if not hmac.compare_digest(sent.encode(), csrf_token(visit.secret).encode()):
                return problem(403, f"the header {CSRF_HEADER} is missing or not of this session")
        return None

    async def _recorded(
        self, auth: Authenticator, route: BaseRoute, visit: Visit, refused: Response | None, call: tuple[Scope, Receive, Send]
    ) -> None:
        """Answer, with a record of it on disk before the answer leaves. What could not be recorded is not begun."""
        scope, receive, send = call
        log = _Log(auth, visit, f"{scope['method']} {getattr(route, 'path', '')}", scope["path"], refused=refused is not None)
        if refused is None:
            try:
                await auth.ready()
            except AbbeError as error:
                await problem(503, f"not done, since it could not be recorded: {error.detail}", error.code, {"Retry-After": "5"})(*call)
                return

        async def record_first(message: Message) -> None:
            if message["type"] == "http.response.start":
                try:
                    await log.answered(int(message["status"]))
                except AbbeError as error:
                    log.unrecorded = True
                    await problem(503, error.detail, error.code, {"Retry-After": "5"})(*call)
            if not log.unrecorded:
                await send(message)

        try:
            await (self._app if refused is None else refused)(scope, receive, record_first)
        except BaseException as error:
            await log.broken(error)
            raise


@dataclass
class _Log:
    """The record of one changing request, however it ends."""

    auth: Authenticator
    visit: Visit
    action: str
    path: str
    refused: bool
    written: bool = False
    unrecorded: bool = False

    async def answered(self, status: int) -> None:
        """Record how it was answered. Refusals of one address are not all recorded; what may have changed something always is."""
        if status == 429 or (status >= 400 and (status < 500 or self.refused) and not self.auth.noise.take(self.visit.address)):
            return
        kind = "replayed" if self.visit.replayed else "done" if status < 400 else "refused" if status < 500 or self.refused else "failed"
        await self._write(f"{kind} {status}")

    async def broken(self, error: BaseException) -> None:
        """Record that it ended in a defect, or was broken off; the service's log has the details."""
        if self.unrecorded:
            return
        try:
            await self._write(f"failed: {type(error).__name__}" + (" after the answer had begun" if self.written else ""))
        except AbbeError as trouble:
            error.add_note(f"not recorded: {trouble}")

    async def _write(self, outcome: str) -> None:
        visit = self.visit
        event = AuditEvent(
            who=visit.who or visit.principal.name,
            action=self.action,
            target=visit.target or self.path,
            outcome=outcome,
            doc={"address": visit.address},
        )
        await self.auth.record(event)
        self.written = True


def _unknown(request: HTTPConnection, principal: Principal, *, changes: bool) -> Response | None:
    # Without users everybody may look; to change something one has to be somebody.
    if principal is NOBODY or (changes and principal.by == "nobody"):
        if "text/html" in request.headers.get("accept", "") and not changes and request.scope["type"] == "http":
            return RedirectResponse("/login", 303)
        return problem(401, "log in, or send a token", headers={"WWW-Authenticate": "Bearer"})
    return None


def _bearer(request: HTTPConnection) -> str | None:
    kind, _, text = request.headers.get("authorization", "").partition(" ")
    return text.strip() if kind.lower() == "bearer" else None


async def _answer(response: Response, scope: Scope, receive: Receive, send: Send) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008})
        return
    await response(scope, receive, send)
