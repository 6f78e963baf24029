"""Login and logout, and the routes for admins and auditors."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from math import ceil
from typing import Annotated, cast

from fastapi import FastAPI, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from jinja2 import Environment

from abbe.service.domain.people import Permission, UserRecord
from abbe.service.domain.service_records import AuditEvent
from abbe.service.queries import people
from abbe.service.users.lockout import LoginOrigin
from abbe.service.users.people import DEVICE_LIFE, MOST_WRONG_PINS
from abbe.service.web.bodies import form_of
from abbe.service.web.listening import is_local
from abbe.service.web.login.access import PUBLIC, needs
from abbe.service.web.login.auth_middleware import Visit
from abbe.service.web.login.authentication import Authenticator, csrf_token
from abbe.service.web.login.origin import is_tls
from abbe.service.web.problems import problem
from abbe.service.web.schemas import AuditList, Me, Problem, StopToken, UserList

LONGEST_FORM = 4096


def add_login(app: FastAPI, env: Environment, auth: Authenticator) -> None:
    """Add login, logout and the user routes to the application."""
    say = cast("Callable[..., str]", env.globals["t"])

    async def page(request: Request, status: int, text: str = "", wait_s: float = 0.0) -> HTMLResponse:
        headers = {"Retry-After": str(ceil(wait_s))} if wait_s else None
        here = await asyncio.to_thread(_with_pin_here, auth, request)
        stop = await _stop_csrf(auth, request)
        return HTMLResponse(env.get_template("login.html").render(text=text, here=here, stop=stop), status, headers)

    @app.get("/login", include_in_schema=False)
    @needs(PUBLIC)
    async def form(request: Request) -> HTMLResponse:
        return await page(request, 200)

    @app.post("/login", include_in_schema=False, max_body_size=LONGEST_FORM)
    @needs(PUBLIC)
    async def login(request: Request) -> Response:
        visit: Visit = request.state.visit
        fields = await form_of(request)
        if fields is None:
            return problem(413, "a login has only the two fields name and password (or PIN)")
        name, by_pin = fields.get("name", ""), "pin" in fields
        visit.target = "unknown user"
        origin = await asyncio.to_thread(_login_origin, auth, request, name, pin=by_pin)
        if by_pin and not origin.device:
            return await page(request, 401, say("login.password_first"))
        user, wait_s, tried = await identified(auth, origin, name, fields.get("pin" if by_pin else "password", ""))
        if tried and await asyncio.to_thread(auth.people.known, name):
            visit.target = f"{name}, by PIN" if by_pin else name
        if user is None:
            removed = by_pin and tried and name not in await asyncio.to_thread(_with_pin_here, auth, request)
            keys = ["login.no_pin"] if removed else _refusals(wait_s, tried=tried)
            text = " ".join(say(key, n=ceil(wait_s)) for key in keys)
            return await page(request, 401 if tried else 429, text, 0.0 if tried else wait_s)
        visit.who = f"user:{user.name}"
        answer = RedirectResponse("/", 303)
        _set_cookie(auth, request, answer, await asyncio.to_thread(auth.people.begin, user, visit.secret))
        if not by_pin:
            _set_device_cookie(auth, request, answer, user, origin.device)
        return answer

    _add_logout(app, auth)
    _add_reading(app, auth)


def _add_logout(app: FastAPI, auth: Authenticator) -> None:
    @app.post("/logout", include_in_schema=False)
    @needs(Permission.READ)
    async def logout(request: Request) -> Response:
        visit: Visit = request.state.visit
        if visit.secret:
            await asyncio.to_thread(auth.people.end, visit.secret)
        answer = RedirectResponse("/login", 303)
        _set_cookie(auth, request, answer, "")
        return answer


async def _stop_csrf(auth: Authenticator, request: Request) -> str:
    """The token with which a session that has run out still stops the machine; empty without such a session."""
    secret = request.cookies.get(auth.cookie(tls=is_tls(request, behind_tls=auth.behind_tls)), "")
    known = await auth.who(None, secret, in_use=False, to_stop=True)
    return csrf_token(secret) if secret and Permission.STOP in known.permissions else ""


async def identified(auth: Authenticator, origin: LoginOrigin, name: str, secret: str) -> tuple[UserRecord | None, float, bool]:
    """Return the user with this name and password (or PIN), or None; seconds until the next try; whether the password was checked at all.

    The password is not checked after too many wrong tries. The audit records the removal of a PIN.
    """
    wait_s = auth.lockout.wait_s(name, origin)
    if wait_s > 0:
        return None, wait_s, False
    # Counted before the password check: simultaneous tries must not all find the account unlocked.
    wait_s = auth.lockout.failed(name, origin)
    if origin.pin:
        user, removed = await asyncio.to_thread(auth.people.check_pin, name, secret)
        if removed:  # a record of its own: those of wrong logins are thinned out
            target, doc = f"user {name}: PIN removed after {MOST_WRONG_PINS} wrong ones", {"address": origin.address}
            await auth.record(AuditEvent(who="anonymous", action="POST /login", target=target, outcome="done", doc=doc))
    else:
        user = await asyncio.to_thread(auth.people.check, name, secret)
    if user is not None:
        auth.lockout.succeeded(name, origin)
    return user, wait_s, True


async def signature_refusal(
    auth: Authenticator, request: Request, password: str, wrong: str = "The password is wrong: nothing was signed."
) -> Response | None:
    """Check the password that a logged-in person gave as signature: return the refusal, or None if the password is right.

    A wrong password counts as a wrong login.
    """
    visit: Visit = request.state.visit
    name = visit.principal.name.partition(":")[2].partition("/")[0]
    origin = await asyncio.to_thread(_login_origin, auth, request, name)
    user, wait_s, tried = await identified(auth, origin, name, password)
    if not tried:
        return problem(429, f"Too many tries. Wait {ceil(wait_s)} s.", headers={"Retry-After": str(ceil(wait_s))})
    again = f" Next try in {ceil(wait_s)} s." if wait_s else ""
    return None if user is not None else problem(403, f"{wrong}{again}")


def _add_reading(app: FastAPI, auth: Authenticator) -> None:
    refusals: dict[int | str, dict[str, object]] = {
        401: {"model": Problem, "description": "No user is logged in"},
        403: {"model": Problem, "description": "The user's role does not allow the request"},
        429: {"model": Problem, "description": "Too many requests"},
        503: {"model": Problem, "description": "The store does not answer"},
    }

    @app.get("/api/v1/session", responses=refusals)
    @needs(Permission.READ)
    async def session(request: Request) -> Me:
        """The current user, their permissions, and the token for the header X-CSRF-Token."""
        visit: Visit = request.state.visit
        who = visit.principal
        token = csrf_token(visit.secret) if visit.secret else ""
        return Me(name=who.name, role=who.role or "", permissions=sorted(who.permissions), csrf_token=token)

    @app.get("/api/v1/stop", responses=refusals)
    @needs(Permission.STOP)
    async def stop_token(request: Request) -> StopToken:
        """The token with which this browser may stop the machine. A session that has run out is enough, as for the stop itself."""
        visit: Visit = request.state.visit
        return StopToken(csrf_token=csrf_token(visit.secret) if visit.secret else "")

    @app.get("/api/v1/users", responses=refusals)
    @needs(Permission.USERS)
    async def users() -> UserList:
        """List users with their roles."""
        return UserList(users=await asyncio.to_thread(people.users, auth.store))

    @app.get("/api/v1/audit", responses=refusals)
    @needs(Permission.AUDIT)
    async def audit(limit: Annotated[int, Query(ge=1, le=1000)] = 100) -> AuditList:
        """List the newest records of the audit, oldest first."""
        return AuditList(records=await asyncio.to_thread(people.audit, auth.store, limit))


def _login_origin(auth: Authenticator, request: Request, name: str, *, pin: bool = False) -> LoginOrigin:
    visit: Visit = request.state.visit
    device = auth.people.device_of(name, request.cookies.get(auth.device_cookie(name), ""))
    return LoginOrigin(visit.address, device, local=is_local(visit.address) and not auth.behind_tls, pin=pin)


def _refusals(wait_s: float, *, tried: bool) -> list[str]:
    """Keys of the texts that tell a visitor why the login failed."""
    return ["login.wait"] if not tried else ["login.wrong", "login.next"] if wait_s else ["login.wrong"]


def _with_pin_here(auth: Authenticator, request: Request) -> list[str]:
    """Names of the users who may log in by PIN in this browser, since they have logged in there by password."""
    names = [user.name for user in auth.people.with_pin()]
    return [name for name in names if auth.people.device_of(name, request.cookies.get(auth.device_cookie(name), ""))]


def _set_device_cookie(auth: Authenticator, request: Request, answer: Response, user: UserRecord, device: str) -> None:
    """Mark a browser after a login by password; the mark of a known browser is renewed."""
    made, life_s = auth.people.new_device(user, device), int(DEVICE_LIFE.total_seconds())
    tls = is_tls(request, behind_tls=auth.behind_tls)
    answer.set_cookie(auth.device_cookie(user.name), made, life_s, path="/login", httponly=True, samesite="strict", secure=tls)


def _set_cookie(auth: Authenticator, request: Request, answer: Response, secret: str) -> None:
    """Set a cookie that the browser drops when it is closed; only the server limits how long the session lasts."""
    tls = is_tls(request, behind_tls=auth.behind_tls)
    age = None if secret else 0
    answer.set_cookie(auth.cookie(tls=tls), secret, max_age=age, path="/", httponly=True, samesite="strict", secure=tls)
