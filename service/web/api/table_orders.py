"""Routes: rollback and push of tables. They pass the order on; the core decides and executes it as a job."""

from __future__ import annotations

from fastapi import FastAPI, Request
from fastapi.responses import Response

from abbe.service.channel.messages import Answer
from abbe.service.domain.job_state import JobState
from abbe.service.users.roles import Permission
from abbe.service.web.api.once import REPLAYED, Key
from abbe.service.web.api.sources import Number
from abbe.service.web.core_link.core_line import CoreLine
from abbe.service.web.jobs import ACCEPTED, REFUSALS, answered
from abbe.service.web.login.access import needs
from abbe.service.web.login.auth_middleware import Visit
from abbe.service.web.schemas import PushBody, RollbackBody

LONGEST_BODY = 4096
RESPONSES = ACCEPTED | REFUSALS


def add_table_orders(app: FastAPI, core: CoreLine) -> None:
    """Add the routes."""

    @app.post("/api/v1/tables/rollback", status_code=202, responses=RESPONSES, response_model=JobState, max_body_size=LONGEST_BODY)
    @needs(Permission.APPROVE)
    async def rollback(request: Request, body: RollbackBody, key: Key) -> Response:
        """Replace the table in force by the one before it, as `abbe comp rollback` does; a refusal (409) gives the reason."""
        visit: Visit = request.state.visit
        visit.target = f"table of push {body.push} ({body.crc})"
        reason = body.reason.replace("\0", "\ufffd")  # not every database can store NUL
        answer = await core.roll_back(body.push, int(body.crc, 16), reason, key, visit.principal.name)
        return _job_answer(core, visit, answer)

    @app.post(
        "/api/v1/proposals/{number}/push",
        status_code=202,
        responses=RESPONSES,
        response_model=JobState,
        max_body_size=LONGEST_BODY,
    )
    @needs(Permission.APPROVE)
    async def push(request: Request, number: Number, body: PushBody, key: Key) -> Response:
        """Push an approved proposal now, unless the service pushes by itself; a refusal (409) gives the reason."""
        visit: Visit = request.state.visit
        visit.target = f"proposal {number}"
        return _job_answer(core, visit, await core.push(number, key, visit.principal.name))


def _job_answer(core: CoreLine, visit: Visit, answer: Answer) -> Response:
    if answer.job:
        visit.target += f", job {answer.job}"
    visit.replayed = answer.outcome == "done" and bool(answer.text)
    sent = answered(core, answer)
    if visit.replayed:
        sent.headers[REPLAYED] = "true"
    return sent
