"""Routes: proposals of tables, decisions on them, and the journal of pushes."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated

from fastapi import FastAPI, Query, Request
from fastapi.responses import Response

from abbe.service.compensation.proposal_checks import approve as work_approve
from abbe.service.compensation.proposal_checks import reject as work_reject
from abbe.service.compensation.proposal_diff import ACTIVE, compare, diff_json
from abbe.service.compensation.proposal_doc import Proposed, load
from abbe.service.compensation.proposal_states import ProposalStatus, check_waiting, proposal_status, status_of_proposal
from abbe.service.errors import NotStored, Unusable
from abbe.service.push.book import read_entries
from abbe.service.push.entries import JournalEntry
from abbe.service.storage.base import utc_text
from abbe.service.storage.repositories.pages import LARGEST
from abbe.service.users.roles import Permission
from abbe.service.web.api import shapes_tables as s
from abbe.service.web.api.once import Key, once
from abbe.service.web.api.sources import Cursor, Doc, Filter, Limit, Number, Sources, as_stored
from abbe.service.web.login.access import needs
from abbe.service.web.login.auth_middleware import Visit

LONGEST_BODY = 4096


def add_tables(app: FastAPI, sources: Sources) -> None:
    """Add the routes."""
    _add_proposals(app, sources)
    _add_decisions(app, sources)
    _add_pushes(app, sources)


def _add_proposals(app: FastAPI, sources: Sources) -> None:
    @app.get("/api/v1/proposals")
    @needs(Permission.READ)
    def proposals(machine: Filter = None, cursor: Cursor = None, limit: Limit = 50) -> s.Proposals:
        """Proposed tables, newest first, and where each stands."""
        rows, after = sources.page("proposals", {"machine": machine}, cursor, limit)
        return s.Proposals(proposals=_standings(sources, rows), next_cursor=after)

    @app.get("/api/v1/proposals/{number}")
    @needs(Permission.READ)
    def proposal(number: Number) -> s.ProposalDetail:
        """One proposal: what it promises with its uncertainty, where it stands, what spoke against it."""
        row = sources.row("proposals", number, "proposal")
        with as_stored():
            return _detail(sources, row, load(sources.store, number))

    @app.get("/api/v1/proposals/{number}/diff")
    @needs(Permission.READ)
    def diff(
        number: Number,
        other: Annotated[
            int | None, Query(alias="with", ge=1, le=LARGEST, description="Another proposal; absent: the table in force.")
        ] = None,
    ) -> s.Diff:
        """What a proposal changes: nine tables in numbers, with uncertainty."""
        for one in (number, other or number):
            sources.row("proposals", one, "proposal")
        with as_stored():
            return s.Diff.model_validate(diff_json(compare(sources.store, number, ACTIVE if other is None else str(other))))


def _add_decisions(app: FastAPI, sources: Sources) -> None:
    @app.post("/api/v1/proposals/{number}/approve", response_model=s.Decision, max_body_size=LONGEST_BODY)
    @needs(Permission.APPROVE)
    async def approve(request: Request, number: Number, body: s.ApproveBody, key: Key) -> Response:
        """Approve exactly this table on exactly this base, by the rules of `abbe comp approve`; refused (409) says why."""
        name, account = _person(request)

        def work() -> s.Decision:
            proposed = _waiting(sources, number)
            done = work_approve(sources.store, number, proposed, name, body.hours, sources.clock, account)
            return s.Decision(proposal=number, decision="approved", by=name, utc=done.utc, expiry=done.expiry)

        return await once(sources.store, request, key, body, work)

    @app.post("/api/v1/proposals/{number}/reject", response_model=s.Decision, max_body_size=LONGEST_BODY)
    @needs(Permission.APPROVE)
    async def reject(request: Request, number: Number, body: s.RejectBody, key: Key) -> Response:
        """Reject a proposal for good, with a reason: nobody can approve or push it any more."""
        name, account = _person(request)
        reason = body.reason.replace("\0", "\ufffd")  # the one character that not every database can keep

        def work() -> s.Decision:
            _waiting(sources, number)
            done = work_reject(sources.store, number, name, reason, account)
            return s.Decision(proposal=number, decision="rejected", by=name, utc=done.utc, reason=done.reason)

        return await once(sources.store, request, key, body, work)


def _waiting(sources: Sources, number: int) -> Proposed:
    sources.row("proposals", number, "proposal")
    with as_stored():
        proposed = load(sources.store, number)
        check_waiting(sources.store, number, proposed, sources.clock.utc().timestamp())
    return proposed


def _person(request: Request) -> tuple[str, str]:
    """Who decides, and by which account: a token is its owner's, so nobody is two people by means of one."""
    visit: Visit = request.state.visit
    account = visit.principal.name
    return account.partition(":")[2].partition("/")[0], account


def _standings(sources: Sources, rows: list[Doc]) -> list[s.Proposal]:
    """Where proposals stand; journals and tables are read once for all of them."""
    store, now_s = sources.store, sources.clock.utc().timestamp()
    tables = {t.id: t.doc for t in store.tables()} if rows else {}
    journals: dict[str, list[JournalEntry]] = {}
    found = []
    for row in rows:
        number, machine = row["id"], row["machine"]
        try:
            with as_stored():
                proposed = load(store, number)
                if machine not in journals:
                    journals[machine] = read_entries(store, machine, sources.control_of(machine))
                decided = (store.approvals(number), journals[machine], tables, now_s, store.rejections(number))
                now = status_of_proposal(number, proposed, *decided)
        except (Unusable, NotStored) as error:  # one bad row must not hide the others
            now = ProposalStatus("changed", error.detail)
        found.append(_proposal(row, now))
    return found


def _proposal(row: Doc, now: ProposalStatus) -> s.Proposal:
    return s.Proposal.model_validate(_head(row, now))


def _head(row: Doc, now: ProposalStatus) -> Doc:
    known = {"number": row["id"], "machine": row["machine"], "solution": row["solution_id"], "created_utc": row["created_utc"]}
    return known | {"state": now.word, "why": now.text}


def _detail(sources: Sources, row: Doc, proposed: Proposed) -> s.ProposalDetail:
    number, store = row["id"], sources.store
    now = proposal_status(store, number, proposed, sources.clock.utc().timestamp())
    p, c = proposed.predicted, proposed.candidate
    return s.ProposalDetail(
        **_head(row, now),
        campaign=proposed.campaign,
        by=proposed.by,
        valid_until=utc_text(datetime.fromtimestamp(proposed.valid_until_s, UTC)),
        predicted_rms_um=s.Predicted(before=p.before_mm * 1e3, after=p.after_mm * 1e3, u_model=p.u_model_mm * 1e3),
        base_crc=f"{c.base_crc:08X}",
        generation=proposed.base.gen,
        digest=c.digest,
        two_people=proposed.two_people,
        reasons=list(proposed.reasons),
        not_for_tables=list(proposed.not_for_tables),
        approvals=[s.Approval.model_validate(one, from_attributes=True) for one in store.approvals(number)],
        rejections=[s.Rejection.model_validate(one, from_attributes=True) for one in store.rejections(number)],
    )


def _add_pushes(app: FastAPI, sources: Sources) -> None:
    @app.get("/api/v1/pushes")
    @needs(Permission.READ)
    def pushes(
        machine: Filter = None,
        push: Annotated[int | None, Query(ge=1, le=LARGEST, description="Only this push; each machine counts its own.")] = None,
        state: Filter = None,
        cursor: Cursor = None,
        limit: Limit = 50,
    ) -> s.PushEntries:
        """The journal of pushes, newest entry first; of a machine that was renamed under the name that its journal was begun with."""
        journal = machine and sources.store.push_chain(machine, sources.control_of(machine))
        rows, after = sources.page("pushes", {"machine": journal, "push": push, "state": state}, cursor, limit)
        return s.PushEntries(entries=[s.PushEntry(number=row["id"], **row) for row in rows], next_cursor=after)

    @app.get("/api/v1/pushes/{number}")
    @needs(Permission.READ)
    def push_entry(number: Number) -> s.PushEntryDetail:
        """One entry of the journal, with everything that became known with it."""
        row = sources.row("pushes", number, "entry of a push")
        return s.PushEntryDetail(number=row["id"], known=row["doc"], **row)
