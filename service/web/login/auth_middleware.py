"""Middleware that checks rate, identity, body length, permission and origin before every route, and records changing requests.

Pure ASGI. It reads no body of an unknown visitor. A request that stops the machine passes with a session that is idle or too old, and does
not wait for the audit.
"""

from __future__ import annotations

import hmac
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import structlog
from starlette.requests import HTTPConnection
from starlette.responses import RedirectResponse, Response
from starlette.routing import BaseRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from abbe.service.domain.people import Permission
from abbe.service.domain.service_records import AuditEvent
from abbe.service.errors import AbbeError
from abbe.service.users.people import ANONYMOUS, LOCAL_VIEWER, Principal
from abbe.service.web.bodies import Body
from abbe.service.web.login.access import ACTIVE_HEADER, MUTATING, PUBLIC, Need, in_use, need_of, route_of
from abbe.service.web.login.authentication import Authenticator, csrf_token
from abbe.service.web.login.origin import address_of, is_ours, is_tls
from abbe.service.web.problems import problem

CSRF_HEADER = "X-CSRF-Token"
stop_log = structlog.get_logger("abbe.audit")


@dataclass
class Visit:
    """Facts about a request; handlers find them in ``request.state.visit`` and may set ``target`` and ``who`` for the audit.

    ``replayed``: the stored answer was sent again, and nothing was done.
    """

    principal: Principal
    address: str
    secret: str = ""
    target: str = ""
    who: str = ""
    replayed: bool = False


class AuthMiddleware:
    """Passes allowed requests on to ``app``.

    ``routes`` is read at each request, so it may grow later. Without ``auth`` there are no users: every visitor may look, and no request
    may change anything.
    """

    def __init__(self, app: ASGIApp, routes: Sequence[BaseRoute], auth: Authenticator | None) -> None:
        self._app, self._routes, self._auth = app, routes, auth
        self._behind_tls = auth is not None and auth.behind_tls

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or answer it."""
        if scope["type"] not in {"http", "websocket"}:
            await self._app(scope, receive, send)
            return
        request = HTTPConnection(scope)
        address = address_of(request, behind_tls=self._behind_tls)
        if self._auth is not None and not self._auth.requests.take(address):
            await _answer(problem(429, "too many requests from this address", headers={"Retry-After": "1"}), scope, receive, send)
            return
        route = route_of(self._routes, scope)
        visit = Visit(ANONYMOUS, address)
        scope.setdefault("state", {})["visit"] = visit
        if route is None:  # the router distinguishes unknown paths from unknown methods
            if _reads_html(request):  # the screen with the error has the visitor's Stop
                with suppress(AbbeError):
                    await self._identify(request, visit, Permission.READ, used=False)
            await self._app(scope, receive, send)
            return
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
        """Response that refuses the request; None: allowed. ``body``: body of a changing request."""
        if need is None:
            return problem(403, "this route declares no permission")
        changes = body is not None
        if need is not PUBLIC or (changes and self._secret(request)):
            used = changes or in_use(request.url.path, request.headers.get(ACTIVE_HEADER))
            await self._identify(request, visit, need, used=used)
        if need is not PUBLIC and (unknown := _unknown(request, visit.principal, changes=changes)) is not None:
            return unknown
        if body is not None and (too_long := await body.refusal()) is not None:
            return too_long
        if need is not PUBLIC and need not in visit.principal.permissions:
            return problem(403, f"the role {visit.principal.role} may not do this: it needs the permission {need.value!r}")
        if changes or request.scope["type"] == "websocket":
            return self._foreign(request, visit, need, changes=changes)
        return None

    def _secret(self, request: HTTPConnection) -> str:
        tls = is_tls(request, behind_tls=self._behind_tls)
        return "" if self._auth is None else request.cookies.get(self._auth.cookie(tls=tls), "")

    async def _identify(self, request: HTTPConnection, visit: Visit, need: Need, *, used: bool) -> None:
        """Find out who visits; ``used``: the request counts as use of the session."""
        secret = self._secret(request)
        visit.principal = LOCAL_VIEWER
        if self._auth is not None:
            visit.principal = await self._auth.who(_bearer(request), secret, in_use=used, to_stop=need is Permission.STOP)
        visit.secret = secret if visit.principal.by == "session" else ""

    def _foreign(self, request: HTTPConnection, visit: Visit, need: Need, *, changes: bool) -> Response | None:
        """Refuse a request from another site's page. Browsers always send the origin; programs send a token, no cookie that a page could
        misuse."""
        origin = request.headers.get("origin")
        by_token = visit.principal.by == "token"
        if not (origin is None and by_token) and not is_ours(request, origin, behind_tls=self._behind_tls):
            return problem(403, "the request came from a foreign page (Origin)")
        if changes and need is not PUBLIC and not by_token:
            sent = request.headers.get(CSRF_HEADER, "")
            if not hmac.compare_digest(sent.encode(), csrf_token(visit.secret).encode()):
                return problem(403, f"the header {CSRF_HEADER} is missing or does not belong to this session")
        return None

    async def _recorded(
        self, auth: Authenticator, route: BaseRoute, visit: Visit, refused: Response | None, call: tuple[Scope, Receive, Send]
    ) -> None:
        """Answer once the record is on disk. Work that cannot be recorded does not begin; a stop does."""
        scope, receive, send = call
        log = _Log(auth, visit, f"{scope['method']} {getattr(route, 'path', '')}", scope["path"], refused=refused is not None)
        stops = need_of(route) is Permission.STOP
        if refused is None and not stops:
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
                    if stops and refused is None:
                        stop_log.error("a stop was not recorded", cause=error.detail, who=visit.principal.name)
                        await send(message)
                        return
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
        """Record the status of the answer. Only a few refusals per address are recorded (429: none); a request that may have changed
        something is always recorded."""
        if status == 429 or (status >= 400 and (status < 500 or self.refused) and not self.auth.recorded_refusals.take(self.visit.address)):
            return
        kind = "replayed" if self.visit.replayed else "done" if status < 400 else "refused" if status < 500 or self.refused else "failed"
        await self._write(f"{kind} {status}")

    async def broken(self, error: BaseException) -> None:
        """Record that the request failed or was cancelled; the service's log has the details."""
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
    # Without users everybody may look; a change needs a known user.
    if principal is ANONYMOUS or (changes and principal.by == "nobody"):
        if _reads_html(request) and not changes and request.scope["type"] == "http":
            return RedirectResponse("/login", 303)
        return problem(401, "log in, or send a token", headers={"WWW-Authenticate": "Bearer"})
    return None


def _reads_html(request: HTTPConnection) -> bool:
    return "text/html" in request.headers.get("accept", "")


def _bearer(request: HTTPConnection) -> str | None:
    kind, _, text = request.headers.get("authorization", "").partition(" ")
    return text.strip() if kind.lower() == "bearer" else None


async def _answer(response: Response, scope: Scope, receive: Receive, send: Send) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008})
        return
    await response(scope, receive, send)
