"""Users on the page: an admin adds, disables and changes users; all users change their own password and PIN. `abbe user` calls the same
functions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

from fastapi import FastAPI, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from pydantic import AfterValidator

from abbe.service.domain.people import Permission, Role
from abbe.service.errors import PasswordRefused, UserRefused
from abbe.service.queries.people import users as listed_users
from abbe.service.rendering.phrases import phrase
from abbe.service.web.bodies import form_of
from abbe.service.web.frame import current
from abbe.service.web.login.access import needs
from abbe.service.web.login.auth_middleware import Visit
from abbe.service.web.login.login import signature_refusal
from abbe.service.web.pages.context import PageContext, can_be_stored
from abbe.service.web.problems import problem

LONGEST_FORM = 4096
Form = dict[str, str]


def add_user_pages(app: FastAPI, context: PageContext) -> None:
    """Add the screens of users and the forms of an own password and PIN to the application."""
    _add_screens(app, context)
    _add_forms(app, context)
    _add_own(app, context)


def _add_screens(app: FastAPI, context: PageContext) -> None:
    async def listed(status: int) -> HTMLResponse:
        users = await context.read(listed_users, context.store)
        return await context.show("users.html", status, users=users, roles=tuple(Role))

    @app.get("/users", include_in_schema=False)
    @needs(Permission.USERS)
    async def every() -> HTMLResponse:
        return await listed(200)

    @app.get("/user", include_in_schema=False)
    @needs(Permission.USERS)
    async def one(name: Annotated[str, Query(max_length=64), AfterValidator(can_be_stored)] = "") -> Response:
        user = next((user for user in await context.read(listed_users, context.store) if user.name == name), None)
        if user is None:
            return await listed(404)
        return await context.show("user.html", user=user, roles=tuple(Role))


def _add_forms(app: FastAPI, context: PageContext) -> None:
    people = context.auth.people

    @app.post("/users/add", include_in_schema=False, max_body_size=LONGEST_FORM)
    @needs(Permission.USERS)
    async def add(request: Request) -> Response:
        work: Callable[[Form], None] = lambda form: people.add(form.get("name", ""), form.get("role", ""), _same(form))  # noqa: E731
        return await _changed(request, context, lambda form: f"add {form.get('role', '')}", work)

    @app.post("/users/role", include_in_schema=False, max_body_size=LONGEST_FORM)
    @needs(Permission.USERS)
    async def role(request: Request) -> Response:
        what: Callable[[Form], str] = lambda form: f"role {form.get('role', '')}"  # noqa: E731 - a line of the audit
        return await _changed(request, context, what, lambda form: people.set_role(form.get("name", ""), form.get("role", "")))

    @app.post("/users/password", include_in_schema=False, max_body_size=LONGEST_FORM)
    @needs(Permission.USERS)
    async def password(request: Request) -> Response:
        visit: Visit = request.state.visit
        own = visit.principal.name.partition(":")[2].partition("/")[0]  # a token has its owner's

        def work(form: Form) -> None:
            if form.get("name", "") == own:
                raise UserRefused("your own password can only be changed in the settings", "give the present password there")
            people.set_password(form.get("name", ""), _same(form))

        return await _changed(request, context, lambda _: "password", work)

    @app.post("/users/disable", include_in_schema=False, max_body_size=LONGEST_FORM)
    @needs(Permission.USERS)
    async def disable(request: Request) -> Response:
        return await _changed(request, context, lambda _: "disable", lambda form: people.disable(form.get("name", "")))

    @app.post("/users/enable", include_in_schema=False, max_body_size=LONGEST_FORM)
    @needs(Permission.USERS)
    async def enable(request: Request) -> Response:
        return await _changed(request, context, lambda _: "enable", lambda form: people.disable(form.get("name", ""), enable=True))


def _add_own(app: FastAPI, context: PageContext) -> None:
    people = context.auth.people

    @app.post("/settings/password", include_in_schema=False, max_body_size=LONGEST_FORM)
    @needs(Permission.READ)
    async def password(request: Request) -> Response:
        answer = await _own(request, context, lambda name, form: people.set_password(name, _same(form)))
        return answer or RedirectResponse("/login", 303)  # the session has ended with the old password

    @app.post("/settings/pin", include_in_schema=False, max_body_size=LONGEST_FORM)
    @needs(Permission.READ)
    async def pin(request: Request) -> Response:
        answer = await _own(request, context, lambda name, form: people.set_pin(name, form.get("pin", "")))
        return answer or RedirectResponse("/settings", 303)


def _same(form: Form) -> str:
    """The new password, typed twice. Raises PasswordRefused."""
    if form.get("new", "") != form.get("again", ""):
        raise PasswordRefused("the two passwords differ", "type it again")
    return form.get("new", "")


async def _changed(request: Request, context: PageContext, what: Callable[[Form], str], work: Callable[[Form], None]) -> Response:
    """Apply a form about a user, and show the user; a refusal gives the reason. The audit says what was done to whom."""
    visit: Visit = request.state.visit
    form = await form_of(request) or {}
    name = form.get("name", "")[:64]
    if not name:
        return problem(422, "the form needs the name of a user")
    visit.target = f"user {name}: {what(form)[:40]}"
    try:
        await context.read(work, form)
    except (UserRefused, PasswordRefused) as error:
        return problem(409, phrase(current().lang, error.detail), error.code)
    return RedirectResponse("/users", 303)


async def _own(request: Request, context: PageContext, work: Callable[[str, Form], None]) -> Response | None:
    """Apply a form of the logged-in person, who repeats the password; return the refusal, or None."""
    visit: Visit = request.state.visit
    name, form = current().who, await form_of(request) or {}
    if "password" not in form:
        return problem(422, "the form needs the present password")
    if not name:
        return problem(403, "a program has no password")
    visit.target = f"user {name}"
    refused = await signature_refusal(context.auth, request, form.get("password", ""), current().translate("own.wrong"))
    if refused is not None:
        return refused
    try:
        await context.read(work, name, form)
    except (UserRefused, PasswordRefused) as error:
        return problem(409, phrase(current().lang, error.detail), error.code)
    return None
