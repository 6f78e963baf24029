"""A proposal's screen names the risk, and a person who may approve can also reject, with a reason, for good."""

from __future__ import annotations

import pytest

from tests.pages_world import USERS, Served, as_user


@pytest.fixture
def fresh(running: Served) -> int:
    """A proposal that nobody has decided on."""
    row = running.store.proposals.get(running.filled.proposals[2])
    return running.store.proposals.add(row.machine, row.solution_id, row.doc, row.digest)


def test_rejected_for_good_with_a_reason_that_the_audit_has(running: Served, fresh: int) -> None:
    with as_user(running, "anna") as client:
        assert 'action="/proposal/reject"' in client.get(f"/proposal?id={fresh}").text
        assert client.post("/proposal/reject", data={"number": "none", "reason": "x"}).status_code == 422
        assert client.post("/proposal/reject", data={"number": "99999", "reason": "x"}).status_code == 404
        empty = client.post("/proposal/reject", data={"number": str(fresh), "reason": " "})
        assert empty.status_code == 409
        assert empty.json()["detail"] == f"proposal {fresh} cannot be rejected without a reason - give the reason, for the proposer"
        answer = client.post("/proposal/reject", data={"number": str(fresh), "reason": "the cup was loose"})
        assert (answer.status_code, answer.headers["location"]) == (303, f"/proposal?id={fresh}")
        page = client.get(f"/proposal?id={fresh}").text
        assert "by anna: the cup was loose" in page
        assert "/proposal/approve" not in page
        assert "/proposal/reject" not in page, "what would be refused is not offered"
        again = client.post("/proposal/reject", data={"number": str(fresh), "reason": "again"})
        assert again.status_code == 409
        audit = client.get("/audit").text
        assert "rejected a proposal" in audit
    assert [(one.name, one.login, one.reason) for one in running.store.proposals.rejections(fresh)] == [
        ("anna", "user:anna", "the cup was loose")
    ]
    target = f"proposal {fresh}: the cup was loose"
    records = [(one.who, one.action, one.outcome) for one in running.store.audit.events(100) if one.target == target]
    assert records == [("user:anna", "POST /proposal/reject", "done 303")]


@pytest.mark.parametrize("name", [name for name, role in USERS.items() if role != "approver"])
def test_nobody_else_may(running: Served, fresh: int, name: str) -> None:
    with as_user(running, name) as client:
        assert client.post("/proposal/reject", data={"number": str(fresh), "reason": "no"}).status_code == 403
        assert "/proposal/reject" not in client.get(f"/proposal?id={fresh}").text
    assert running.store.proposals.rejections(fresh) == []


def test_the_risk_is_named_before_the_signature(running: Served, fresh: int) -> None:
    with as_user(running, "anna") as client:
        page = client.get(f"/proposal?id={fresh}").text
    assert page.index("Risk: what can go wrong") < page.index('action="/proposal/approve"')
    assert page.index('class="risks"') < page.index("Nothing catches this at once")
