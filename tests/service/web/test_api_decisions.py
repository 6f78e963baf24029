"""Approving and rejecting: the rules of `abbe comp approve`, once for each key, recorded, and a rejection stays one."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Any

import httpx
import pytest

from abbe.service.compensation.proposal_decisions import check_waiting, proposal_status, reject, valid_approval
from abbe.service.compensation.proposal_doc import load
from abbe.service.domain.results import ProposalRejection
from abbe.service.errors import TableRefused
from tests.service.web.api_bench import Plant

BASE = "http://127.0.0.1:8080"


@pytest.fixture
async def client(plant: Plant) -> AsyncIterator[httpx.AsyncClient]:
    async with httpx.AsyncClient(transport=httpx.ASGITransport(plant.app, False), base_url=f"{BASE}/api/v1") as opened:
        yield opened


@pytest.fixture
def fresh(plant: Plant) -> int:
    """A proposal that nobody has decided on."""
    row = plant.store.proposals.get(plant.approvable[0])
    return plant.store.proposals.add(row.machine, row.solution_id, row.doc, row.digest)


async def decide(client: httpx.AsyncClient, number: int, what: str, who: dict[str, str], key: str = "k1", **body: Any) -> httpx.Response:
    return await client.post(f"/proposals/{number}/{what}", json=body, headers={**who, "Idempotency-Key": key})


async def test_approved_by_a_session_is_what_a_push_will_find(client, plant, fresh):
    who = {**plant.session("approver"), "Origin": BASE}
    answer = await decide(client, fresh, "approve", who, key=f"a{fresh}", hours=2)
    assert answer.status_code == 200, answer.text
    assert answer.json() == {
        "proposal": fresh, "decision": "approved", "by": "a-approver", "utc": "2026-11-22T09:00:00.000000Z",
        "expiry": "2026-11-22T11:00:00.000000Z", "reason": None,
    }  # fmt: skip
    proposed = load(plant.store, fresh)
    found, why = valid_approval(proposed, plant.store.proposals.approvals(fresh), plant.clock.utc().timestamp(), two_people=True)
    assert (why, found.name, found.login) == ("", "a-approver", "user:a-approver")
    assert (await client.get(f"/proposals/{fresh}", headers=plant.token("viewer"))).json()["state"] == "approved"
    last = plant.store.audit.events(1)[0]
    assert (last.who, last.target, last.outcome) == ("user:a-approver", f"/api/v1/proposals/{fresh}/approve", "done 200")


async def test_the_same_key_is_answered_again_and_does_nothing_again(client, plant, fresh):
    who = plant.token("approver")
    first = await decide(client, fresh, "approve", who, key="same", hours=3)
    again = await decide(client, fresh, "approve", who, key="same", hours=3)
    assert (first.status_code, again.status_code, again.content) == (200, 200, first.content)
    assert (first.headers.get("idempotent-replayed"), again.headers["idempotent-replayed"]) == (None, "true")
    # The decision stands once in the audit; that somebody sent it again stands there as that.
    told = [one.outcome for one in plant.store.audit.events(10) if one.action.endswith("/approve") and f"/{fresh}/" in one.target]
    assert told[-2:] == ["done 200", "replayed 200"]
    assert len(plant.store.proposals.approvals(fresh)) == 1
    other = await decide(client, fresh, "approve", who, key="same", hours=4)
    assert (other.status_code, other.json()["code"]) == (409, "API-001")
    assert (await decide(client, fresh, "reject", who, key="same", reason="no")).json()["code"] == "API-001"
    assert plant.store.proposals.rejections(fresh) == []
    mine = await decide(client, fresh, "approve", plant.token("approver"), key="same", hours=4)
    assert mine.status_code == 200, "a key belongs to whoever made it up"


async def test_a_refusal_is_kept_for_its_key_too(client, plant):
    who = plant.token("approver")
    for _ in range(2):
        answer = await decide(client, 1, "approve", who, key="refused")
        assert (answer.status_code, answer.json()["code"]) == (409, "CMP-001")
        assert "reasons against it" in answer.json()["detail"]
    assert answer.headers["content-type"] == "application/problem+json"
    assert plant.store.proposals.approvals(1) == []


async def test_requests_that_come_together_are_one(client, plant, fresh):
    who = plant.token("approver")
    answers = await asyncio.gather(*(decide(client, fresh, "approve", who, key="at-once") for _ in range(12)))
    assert {answer.status_code for answer in answers} <= {200, 409}
    assert {answer.json().get("code") for answer in answers if answer.status_code == 409} <= {"API-002"}
    assert len(plant.store.proposals.approvals(fresh)) == 1


async def test_a_key_of_a_request_that_died_can_be_used_again(plant):
    store = plant.store
    assert store.replies.claim("user:x", "k", "d") is None
    assert store.replies.claim("user:x", "k", "d").status is None
    plant.clock.now = plant.clock.now.replace(minute=2)
    try:
        assert store.replies.claim("user:x", "k", "d") is None
        store.replies.keep("user:x", "k", 200, "{}")
        assert store.replies.claim("user:x", "k", "d").body == "{}"
    finally:
        plant.clock.now = plant.clock.now.replace(minute=0)


async def test_nobody_is_two_people_by_a_token(client, plant):
    """Proposal 4 was made by a-approver on a machine that needs two people."""
    for who in ({**plant.session("approver"), "Origin": BASE}, plant.token("approver")):
        answer = await decide(client, 4, "approve", who, key=f"own-{len(plant.store.people.tokens())}")
        assert (answer.status_code, answer.json()["code"]) == (409, "CMP-001")
        assert "second person" in answer.json()["detail"]
    assert plant.store.proposals.approvals(4) == []


async def test_a_rejection_is_final_and_says_why(client, plant, fresh):
    who = plant.token("approver")
    await decide(client, fresh, "approve", who, key=f"y{fresh}")
    answer = await decide(client, fresh, "reject", who, key=f"n{fresh}", reason="the cup was loose <b>\0")
    assert (answer.status_code, answer.json()["decision"], answer.json()["reason"]) == (200, "rejected", "the cup was loose <b>\ufffd")
    now_s = plant.clock.utc().timestamp()
    proposed = load(plant.store, fresh)
    assert proposal_status(plant.store, fresh, proposed, now_s).word == "rejected"
    with pytest.raises(TableRefused, match="rejected"):
        check_waiting(plant.store, fresh, proposed, now_s)
    after = await decide(client, fresh, "approve", who, key=f"z{fresh}")
    assert (after.status_code, after.json()["code"]) == (409, "CMP-001")
    assert (await decide(client, fresh, "reject", who, key=f"zz{fresh}", reason="again")).status_code == 409
    told = (await client.get(f"/proposals/{fresh}", headers=plant.token("viewer"))).json()
    assert (told["state"], told["rejections"][0]["reason"]) == ("rejected", "the cup was loose <b>\ufffd")


async def test_a_push_is_told_of_a_rejection(plant, fresh):
    from abbe.service.compensation.gate import PushPrecheck

    rejection = reject(plant.store, fresh, "somebody", "no", plant.clock, "user:somebody")
    assert isinstance(rejection, ProposalRejection)
    held = PushPrecheck.__new__(PushPrecheck)
    object.__setattr__(held, "rejections", (rejection,))
    assert list(held._rejected()) == [f"REJECTED: by somebody at {rejection.utc}: no"]


@pytest.mark.parametrize("reason", ["", "   ", "x" * 501, None, 5, ["no"]])
async def test_a_rejection_needs_a_reason(client, plant, fresh, reason):
    answer = await decide(client, fresh, "reject", plant.token("approver"), key=f"r{fresh}", reason=reason)
    assert answer.status_code in {409, 422}
    assert plant.store.proposals.rejections(fresh) == []


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (b"", "application/json"),
        (b"{", "application/json"),
        (b'{"hours": NaN}', "application/json"),
        (b'{"hours": 1e999}', "application/json"),
        (b'{"hours": 5, "more": 1}', "application/json"),
        (b'{"hours": 5, "\\ud800": 1}', "application/json"),
        (b"[" * 100_000, "application/json"),
        (b"[" * 4000, "application/json"),
        (b'{"hours": ' + b"9" * 4000 + b"}", "application/json"),
        (b"\xff\xfe", "application/json"),
        (b"hours=5", "application/x-www-form-urlencoded"),
        (b'{"hours": 5}', "text/plain"),
        (b'{"hours": ' + b" " * 1_000_000 + b"5}", "application/json"),
    ],
)
async def test_bodies_that_are_none(client, plant, fresh, content, kind):
    headers = {**plant.token("approver"), "Idempotency-Key": "bad", "Content-Type": kind}
    answer = await client.post(f"/proposals/{fresh}/approve", content=content, headers=headers)
    assert answer.status_code in {400, 413, 422}, answer.text
    assert answer.headers["content-type"].startswith(("application/problem+json", "text/plain"))
    assert plant.store.proposals.approvals(fresh) == []


@pytest.mark.parametrize("key", [None, "", "with space", "k" * 101, "ключ".encode(), "'; DROP TABLE replies; --"])
async def test_without_a_key_nothing_is_decided(client, plant, fresh, key):
    headers: dict[str, Any] = plant.token("approver") | ({} if key is None else {"Idempotency-Key": key})
    answer = await client.post(f"/proposals/{fresh}/approve", json={}, headers=headers)
    assert (answer.status_code, answer.json()["code"]) == (422, "WEB-422")
    assert plant.store.proposals.approvals(fresh) == []
