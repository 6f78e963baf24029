"""Routes: proposed tables, decisions on them, the push journal, and orders to push or roll back."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

from fastapi import FastAPI, Query, Request
from fastapi.responses import Response

from abbe.service.channel.messages import Answer
from abbe.service.compensation.proposal_decisions import approve as work_approve
from abbe.service.compensation.proposal_decisions import reject as work_reject
from abbe.service.domain.people import Permission
from abbe.service.domain.progress import JobState
from abbe.service.domain.push_entry import PushEntry
from abbe.service.queries import tables
from abbe.service.queries.reader import as_stored
from abbe.service.storage.repositories.pages import LARGEST
from abbe.service.web.api.once import REPLAYED, Key, once
from abbe.service.web.api.sources import Cursor, Filter, Limit, Number, Sources
from abbe.service.web.core_link.core_line import CoreLine
from abbe.service.web.jobs import ACCEPTED, REFUSALS, answered
from abbe.service.web.login.access import needs
from abbe.service.web.login.auth_middleware import Visit
from abbe.service.web.schemas import ApproveBody, Decision, ProposalList, PushBody, PushJournal, RejectBody, RollbackBody

LONGEST_BODY = 4096


def add_tables(app: FastAPI, sources: Sources) -> None:
    """Add the routes of proposals, decisions and the push journal to the application."""
    _add_proposals(app, sources)
    _add_decisions(app, sources)
    _add_pushes(app, sources)


def _add_proposals(app: FastAPI, sources: Sources) -> None:
    @app.get("/api/v1/proposals")
    @needs(Permission.READ)
    def proposals(machine: Filter = None, cursor: Cursor = None, limit: Limit = 50) -> ProposalList:
        """Proposed tables with their states, newest first."""
        found, after = tables.proposals(sources.reader, machine, cursor, limit)
        return ProposalList(proposals=found, next_cursor=after)

    @app.get("/api/v1/proposals/{number}")
    @needs(Permission.READ)
    def proposal(number: Number) -> tables.ProposalDetail:
        """One proposal: predicted improvement with uncertainty, state, and the reasons against it."""
        return tables.proposal(sources.reader, number)

    @app.get("/api/v1/proposals/{number}/diff")
    @needs(Permission.READ)
    def diff(
        number: Number,
        other: Annotated[
            int | None,
            Query(alias="with", ge=1, le=LARGEST, description="Number of the proposal to compare with; absent: the table in force."),
        ] = None,
    ) -> tables.ProposalDifference:
        """Changes of a proposal: nine tables in numbers, with uncertainty."""
        return tables.difference(sources.reader, number, other)


def _add_decisions(app: FastAPI, sources: Sources) -> None:
    reader = sources.reader

    @app.post("/api/v1/proposals/{number}/approve", response_model=Decision, max_body_size=LONGEST_BODY)
    @needs(Permission.APPROVE)
    async def approve(request: Request, number: Number, body: ApproveBody, key: Key) -> Response:
        """Approve exactly this table on exactly this base, by the rules of `abbe comp approve`; a refusal (409) gives the reason."""
        name, account = _person(request)

        def work() -> Decision:
            with _stored(sources, number):
                done = work_approve(reader.store, number, name, body.hours, reader.clock, account)
            return Decision(proposal=number, decision="approved", by=name, utc=done.utc, expiry=done.expiry)

        return await once(reader.store, request, key, body, work)

    @app.post("/api/v1/proposals/{number}/reject", response_model=Decision, max_body_size=LONGEST_BODY)
    @needs(Permission.APPROVE)
    async def reject(request: Request, number: Number, body: RejectBody, key: Key) -> Response:
        """Reject a proposal for good, with a reason: it can no longer be approved or pushed."""
        name, account = _person(request)
        reason = body.reason.replace("\0", "\ufffd")  # not every database can store NUL

        def work() -> Decision:
            with _stored(sources, number):
                done = work_reject(reader.store, number, name, reason, reader.clock, account)
            return Decision(proposal=number, decision="rejected", by=name, utc=done.utc, reason=done.reason)

        return await once(reader.store, request, key, body, work)


@contextmanager
def _stored(sources: Sources, number: int) -> Iterator[None]:
    """Require that the proposal exists; within the context, errors in its stored row become a response."""
    sources.reader.row("proposals", number, "proposal")
    with as_stored():
        yield


def _person(request: Request) -> tuple[str, str]:
    """Name and account of the person who decides; a token counts as its owner, so one person never counts as two."""
    visit: Visit = request.state.visit
    account = visit.principal.name
    return account.partition(":")[2].partition("/")[0], account


def _add_pushes(app: FastAPI, sources: Sources) -> None:
    @app.get("/api/v1/pushes")
    @needs(Permission.READ)
    def journal(
        machine: Filter = None,
        push: Annotated[int | None, Query(ge=1, le=LARGEST, description="Only this push; each machine numbers its own pushes.")] = None,
        state: Filter = None,
        cursor: Cursor = None,
        limit: Limit = 50,
    ) -> PushJournal:
        """The push journal, newest entry first; a renamed machine keeps its journal under the first name."""
        found, after = tables.push_entries(sources.reader, machine, push, state, cursor, limit)
        return PushJournal(entries=found, next_cursor=after)

    @app.get("/api/v1/pushes/{number}")
    @needs(Permission.READ)
    def push_entry(number: Number) -> PushEntry:
        """One entry of the journal with the facts that it recorded."""
        return tables.push_entry(sources.reader, number)


RESPONSES = ACCEPTED | REFUSALS


def add_table_orders(app: FastAPI, core: CoreLine) -> None:
    """Add the routes that order a push or a rollback to the application."""

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
