"""Administration on the page: limits, schedules, certificates, laboratory and customer, each a form that changes the machine file.

The page only sends requests; the core checks permission and file, writes the audit and the file, and starts anew with the new values.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated

from fastapi import FastAPI, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response

from abbe.service.domain.machine_file import FileEdit, MachineFileSummary
from abbe.service.domain.people import Permission
from abbe.service.files import may_replace
from abbe.service.rendering.phrases import phrase
from abbe.service.web.bodies import form_of
from abbe.service.web.core_link.core_line import CoreLine
from abbe.service.web.frame import current
from abbe.service.web.login.access import needs
from abbe.service.web.login.auth_middleware import Visit
from abbe.service.web.login.login import signature_refusal
from abbe.service.web.pages import file_fields
from abbe.service.web.pages.context import PageContext
from abbe.service.web.pages.file_fields import Field, FormError, edits_of, schedule_fields, shown_fields, with_names
from abbe.service.web.problems import problem

LONGEST_FORM, MOST_FIELDS, LONGEST_REASON = 16_384, 60, 500
AGAIN_S = 2
"""Time after which a browser asks again whether the service has started anew, s."""
STATUS = {"forbidden": 403, "busy": 409, "conflict": 409, "unknown": 409}
_NUMBER = re.compile(r"schedule\[([1-9]\d{0,2})\]\.name")
Form = Mapping[str, str]
Made = Callable[[Form, MachineFileSummary], tuple[FileEdit, ...]]


def add_administration(app: FastAPI, context: PageContext, stated: MachineFileSummary | None, core: CoreLine | None) -> None:
    """Add the screen of the administration and its forms to the application. ``core``: None: nothing can be changed."""
    _add_screen(app, context, stated)
    _add_forms(app, _Desk(context, stated, core))


def _add_screen(app: FastAPI, context: PageContext, stated: MachineFileSummary | None) -> None:
    @app.get("/administration", include_in_schema=False)
    @needs(Permission.READ)
    async def screen(was: Annotated[str, Query(pattern="^[0-9a-f]{64}$")] = "") -> HTMLResponse:
        if stated is None:
            return await context.show("administration.html", stated=None, waits=False, done=False)
        waits = was == stated.sha256
        groups = {name: shown_fields(fields, stated) for name, fields in _GROUPS.items()}
        recipes = tuple(dict.fromkeys((*context.recipes, *_recipes(stated))))
        count = len(_recipes(stated))
        plans = [shown_fields(schedule_fields(number, recipes), stated) for number in range(1, count + 2)]
        writable = await context.read(may_replace, Path(stated.path))
        answer = await context.show(
            "administration.html", stated=stated, groups=groups, plans=plans, writable=writable, waits=waits, done=bool(was) and not waits
        )
        if waits:
            answer.headers["Refresh"] = str(AGAIN_S)
        return answer


_GROUPS: Mapping[str, Sequence[Field]] = {
    "issuer": file_fields.ISSUER,
    "item": file_fields.ITEM,
    "verify": file_fields.VERIFY,
    "push": file_fields.PUSH,
    "measure": file_fields.MEASURE,
    "calibration": file_fields.CERTIFICATES,
}


def _recipes(stated: MachineFileSummary) -> list[str]:
    """The recipe of each schedule."""
    return [one.value.strip('"') for one in stated.values if one.key.startswith("schedule[") and one.key.endswith(".recipe")]


class _Desk:
    """Takes the forms of this screen."""

    def __init__(self, context: PageContext, stated: MachineFileSummary | None, core: CoreLine | None) -> None:
        self._context, self._stated, self._core = context, stated, core

    async def take(self, request: Request, made: Made) -> Response:
        """Ask the core for the changes of a form, which the password signs; a refusal gives the reason."""
        visit: Visit = request.state.visit
        form = await form_of(request, MOST_FIELDS, blank=True)
        if form is None or "password" not in form or "sha256" not in form:
            return problem(422, "the form needs the password and the fingerprint of the machine file")
        if self._stated is None or self._core is None:
            return problem(409, phrase(current().lang, "this service was started without a machine file"))
        try:
            edits = made(form, self._stated)
        except FormError as refusal:
            return problem(409, current().translate(refusal.key))
        if not edits and made is not _nothing:
            return problem(409, current().translate("admin.same"))
        refused = await signature_refusal(self._context.auth, request, form["password"], current().translate("own.wrong"))
        if refused is not None:
            return refused
        reason = form.get("reason", "").replace("\0", "\ufffd").strip()[:LONGEST_REASON]
        who, looser = visit.principal.name, form.get("looser") == "yes"
        answer = await self._core.change_file(form["sha256"][:64], edits, reason, who, looser=looser)
        if answer.outcome != "done":
            return problem(STATUS[answer.outcome], with_names(phrase(current().lang, answer.text)))
        return RedirectResponse(f"/administration?was={self._stated.sha256}", 303)


def _add_forms(app: FastAPI, desk: _Desk) -> None:
    @app.post("/administration/laboratory", include_in_schema=False, max_body_size=LONGEST_FORM)
    @needs(Permission.CONFIGURE)
    async def laboratory(request: Request) -> Response:
        return await desk.take(request, lambda form, stated: edits_of(file_fields.LABORATORY, form, stated))

    @app.post("/administration/limits", include_in_schema=False, max_body_size=LONGEST_FORM)
    @needs(Permission.APPROVE)
    async def limits(request: Request) -> Response:
        return await desk.take(request, lambda form, stated: edits_of(file_fields.LIMITS, form, stated))

    @app.post("/administration/certificates", include_in_schema=False, max_body_size=LONGEST_FORM)
    @needs(Permission.APPROVE)
    async def certificates(request: Request) -> Response:
        return await desk.take(request, lambda form, stated: edits_of(file_fields.CERTIFICATES, form, stated))

    @app.post("/administration/schedule", include_in_schema=False, max_body_size=LONGEST_FORM)
    @needs(Permission.CONFIGURE)
    async def schedule(request: Request) -> Response:
        return await desk.take(request, _schedule)

    @app.post("/administration/read", include_in_schema=False, max_body_size=LONGEST_FORM)
    @needs(Permission.CONFIGURE)
    async def read(request: Request) -> Response:
        return await desk.take(request, _nothing)


def _schedule(form: Form, stated: MachineFileSummary) -> tuple[FileEdit, ...]:
    """The changes of one schedule: its values, a new one, or its removal."""
    number = next((int(found[1]) for key in form if (found := _NUMBER.fullmatch(key))), 0)
    count = len(_recipes(stated))
    if not 1 <= number <= count + 1:
        return ()
    if form.get("remove") == "yes":
        return (FileEdit(f"schedule[{number}]", "null"),) if number <= count else ()
    return edits_of(schedule_fields(number, ()), form, stated)


def _nothing(form: Form, stated: MachineFileSummary) -> tuple[FileEdit, ...]:
    return ()
