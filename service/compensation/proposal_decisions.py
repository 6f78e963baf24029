"""A person approves or rejects a stored proposal. Both are possible only while it waits for a push."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import timedelta

from abbe.service.clock import Clock
from abbe.service.compensation.proposal_checks import same_person
from abbe.service.compensation.proposal_doc import Proposed, load
from abbe.service.compensation.proposal_states import proposal_status
from abbe.service.compensation.proposals import login
from abbe.service.domain.decisions import ProposalApproval, ProposalRejection
from abbe.service.domain.utc import utc_text
from abbe.service.errors import TableRefused
from abbe.service.storage.store import Store


def approve(store: Store, number: int, name: str, hours: float, clock: Clock, account: str | None = None) -> ProposalApproval:
    """Approve a proposal: exactly this table on exactly this base, for this machine, under these limits, for some hours.

    The approval ends at the latest when the measurement becomes too old.

    Parameters
    ----------
    account : str, optional
        The approver's account. Default: that of this command line.

    Raises
    ------
    TableRefused
        With all reasons: it does not wait for a push, it was proposed with reasons against it, its measurement is too old, or the approver
        is the proposer where two people are needed.
    StoreError
        There is no such proposal, or its row was changed.
    """
    now = clock.utc()
    proposed = load(store, number)
    check_waiting(store, number, proposed, now.timestamp())
    against = list(_against_approval(number, proposed, name, now.timestamp()))
    if against:
        raise TableRefused.because([reason for reason, _ in against], against[0][1])
    left_s = proposed.valid_until_s - now.timestamp()
    expiry = utc_text(now + timedelta(seconds=min(hours * 3600.0, left_s)))
    store.proposals.approve(
        ProposalApproval(proposal_id=number, name=name, login=account or login(), digest=proposed.binding(expiry), expiry=expiry)
    )
    return store.proposals.approvals(number)[-1]


def _against_approval(number: int, proposed: Proposed, name: str, now_s: float) -> Iterator[tuple[str, str]]:
    """Yield each reason against an approval with its remedy."""
    if proposed.reasons:
        yield f"proposal {number} has reasons against it and cannot be approved: {proposed.reasons[0]}", "propose again"
    if now_s >= proposed.valid_until_s:
        yield f"the measurement of proposal {number} is older than {proposed.limits.age_h:g} h", "measure again"
    if proposed.two_people and same_person(name, proposed.by):
        yield f"{name} proposed it: this machine needs a second person to approve", "let somebody else approve it"


def reject(store: Store, number: int, name: str, reason: str, clock: Clock, account: str | None = None) -> ProposalRejection:
    """Reject a proposal for good: whatever approvals it has, it can no longer be approved or pushed. New tables need a new proposal.

    Raises
    ------
    TableRefused
        No reason is given, or it does not wait for a push.
    StoreError
        There is no such proposal, or its row was changed.
    """
    check_waiting(store, number, load(store, number), clock.utc().timestamp())
    if not reason.strip():
        raise TableRefused(f"proposal {number} is not rejected without a reason", "say why; the proposer has to know")
    store.proposals.reject(ProposalRejection(proposal_id=number, name=name, login=account or login(), reason=reason.strip()))
    return store.proposals.rejections(number)[-1]


def check_waiting(store: Store, number: int, proposed: Proposed, now_s: float) -> None:
    """Refuse a decision on a proposal that does not wait for a push.

    Raises
    ------
    TableRefused
        Names its present status.
    """
    now = proposal_status(store, number, proposed, now_s)
    if now.word not in ("proposed", "approved", "refused"):  # `approve` names the reasons against a refused one
        raise TableRefused(f"proposal {number} is {now.word}: {now.text}", "propose again")
