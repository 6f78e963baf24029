"""The status of a proposal, and the decisions of people on it: approval and rejection, possible only while it waits for a push.

The status is derived from the proposal's row, its approvals and the push journal. It is stored nowhere else.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

from abbe.service.audit.book import login
from abbe.service.clock import Clock, utc_text
from abbe.service.compensation.proposal_doc import Proposed, load
from abbe.service.domain.push_entry import TERMINAL, PushState
from abbe.service.domain.results import ProposalApproval, ProposalRejection
from abbe.service.errors import TableRefused
from abbe.service.push.journal import Journal, facts
from abbe.service.storage.store import Store
from abbe.service.tables.push_journal import KIND, JournalView


@dataclass(frozen=True, slots=True)
class ProposalStatus:
    """A status word and one sentence. Words: refused, rejected, proposed, approved, expired, superseded, pushed, kept, rolled back."""

    word: str
    text: str


def proposal_status(store: Store, number: int, proposed: Proposed, now_s: float, journal: JournalView | None = None) -> ProposalStatus:
    """The status of a stored proposal. ``journal``: the journal of its machine, if the caller has already read it."""
    journal = journal or JournalView.read(store, proposed.candidate.machine)
    return status_of_proposal(number, proposed, store.proposals.approvals(number), store.proposals.rejections(number), journal, now_s)


def status_of_proposal(
    number: int,
    proposed: Proposed,
    approvals: Sequence[ProposalApproval],
    rejections: Sequence[ProposalRejection],
    journal: JournalView,
    now_s: float,
) -> ProposalStatus:
    """The status of a proposal from plain values; reads no store."""
    own = [push for push in journal.pushes.values() if journal.origin(push).proposal == number]
    if own:
        found = _pushed(own[-1], journal)
        if found is not None:
            return found
    if rejections:
        return ProposalStatus("rejected", f"by {rejections[-1].name}: {rejections[-1].reason}")
    if proposed.reasons:
        return ProposalStatus("refused", f"reasons against it when it was proposed: {len(proposed.reasons)}")
    wrote = [e.push for e in journal.entries if e.state is PushState.STAGING and e.utc > proposed.utc]
    if wrote:
        return ProposalStatus("superseded", f"push {wrote[-1]} has written into the controller since the proposal")
    if now_s >= proposed.valid_until_s:
        return ProposalStatus("expired", f"its measurement is older than {proposed.limits.age_h:g} h")
    approval, why = valid_approval(proposed, approvals, now_s, two_people=proposed.two_people)
    if approval is not None:
        return ProposalStatus("approved", f"by {approval.name} until {_minute(approval.expiry)}")
    return ProposalStatus("proposed", why if approvals or proposed.two_people else "waits for a push")


def _pushed(own: Journal, journal: JournalView) -> ProposalStatus | None:
    """End of the proposal's last push; None if that push ended before the new table was in force."""
    last, f = own[-1], facts(own)
    if last.state in (PushState.REJECTED, PushState.ABORTED):
        return None
    if last.state is PushState.ROLLED_BACK:
        return ProposalStatus("rolled back", f"by push {last.push} itself: {f.why}")
    if last.state is not PushState.KEEP:
        open_ = "" if last.state in TERMINAL else "; the next command that uses the machine finishes the push"
        return ProposalStatus("pushed", f"push {last.push} is in state {last.state}{open_}")
    later = [j for n, j in journal.pushes.items() if n > last.push and j[-1].state is PushState.KEEP]
    if not later:
        return ProposalStatus("kept", f"push {last.push}: {f.verify}")
    if facts(later[-1]).image == f.image:
        return ProposalStatus("kept", f"push {last.push} kept the table; in force again since push {later[-1][-1].push}")
    number = later[0][-1].push
    if journal.origin(later[0]).kind == KIND:
        return ProposalStatus("rolled back", f"by order of a person with push {number}, after push {last.push} had kept the table")
    return ProposalStatus("superseded", f"push {last.push} kept the table; push {number} put another table in its place")


def valid_approval(
    proposed: Proposed, approvals: Sequence[ProposalApproval], now_s: float, *, two_people: bool
) -> tuple[ProposalApproval | None, str]:
    """Return the last valid approval and an empty text; otherwise None and the reason."""
    why = "not approved yet"
    for row in reversed(approvals):
        if two_people and same_person(row.name, proposed.by):
            why = f"{row.name} proposed it and cannot approve it"
        elif row.digest != proposed.binding(row.expiry):
            why = f"{row.name} approved another table, base, machine or limits"
        elif now_s >= _utc_s(row.expiry):
            why = f"the approval of {row.name} expired at {_minute(row.expiry)}"
        else:
            return row, ""
    return None, why


def same_person(one: str, other: str) -> bool:
    """Whether two names belong to the same person: letter case and outer blanks are ignored."""
    return one.strip().casefold() == other.strip().casefold()


def _minute(utc: str) -> str:
    """A stored time for people, to the minute."""
    return f"{utc[:10]} {utc[11:16]} UTC"


def _utc_s(text: str) -> float:
    return datetime.fromisoformat(text).timestamp()


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
        With all reasons: the proposal does not wait for a push or had reasons against it from the start, its measurement is too old, or the
        approver is the proposer where two people are needed.
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
        yield f"{name} proposed it: this machine needs a second person to approve", "ask another person to approve it"


def reject(store: Store, number: int, name: str, reason: str, clock: Clock, account: str | None = None) -> ProposalRejection:
    """Reject a proposal for good: whatever approvals it has, it can no longer be approved or pushed. New tables need a new proposal.

    Raises
    ------
    TableRefused
        No reason is given, or the proposal does not wait for a push.
    StoreError
        There is no such proposal, or its row was changed.
    """
    check_waiting(store, number, load(store, number), clock.utc().timestamp())
    if not reason.strip():
        raise TableRefused(f"proposal {number} cannot be rejected without a reason", "give the reason, for the proposer")
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
        what = f"proposal {number} can no longer be approved or rejected: it is {now.word}: {now.text}"
        raise TableRefused(what, "propose again")
