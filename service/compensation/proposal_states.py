"""The status of a proposal, derived from its row, its approvals and the push journal. It is stored nowhere else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from abbe.service.compensation.proposal_checks import valid_approval
from abbe.service.compensation.proposal_doc import Proposed
from abbe.service.domain.decisions import ProposalApproval, ProposalRejection
from abbe.service.domain.push_entry import TERMINAL, PushState
from abbe.service.push.journal import Journal, facts
from abbe.service.storage.store import Store
from abbe.service.tables.push_journal import KIND, JournalView


@dataclass(frozen=True, slots=True)
class ProposalStatus:
    """A status word and one sentence. Words: refused, rejected, proposed, approved, expired, superseded, pushed, kept, rolled back."""

    word: str
    text: str


def proposal_status(store: Store, number: int, proposed: Proposed, now_s: float, journal: JournalView | None = None) -> ProposalStatus:
    """The status of a stored proposal. ``journal``: that of its machine, if the caller has read it already."""
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
        return ProposalStatus("refused", f"{len(proposed.reasons)} reasons against it when it was proposed")
    wrote = [e.push for e in journal.entries if e.state is PushState.STAGING and e.utc > proposed.utc]
    if wrote:
        return ProposalStatus("superseded", f"push {wrote[-1]} wrote into the controller since it was proposed")
    if now_s >= proposed.valid_until_s:
        return ProposalStatus("expired", f"its measurement is older than {proposed.limits.age_h:g} h")
    approval, why = valid_approval(proposed, approvals, now_s, two_people=proposed.two_people)
    if approval is not None:
        return ProposalStatus("approved", f"by {approval.name} until {approval.expiry}")
    return ProposalStatus("proposed", why if approvals or proposed.two_people else "waits for a push")


def _pushed(own: Journal, journal: JournalView) -> ProposalStatus | None:
    """How the proposal's last push ended; None if that push ended before the new table was in force."""
    last, f = own[-1], facts(own)
    if last.state in (PushState.REJECTED, PushState.ABORTED):
        return None
    if last.state is PushState.ROLLED_BACK:
        return ProposalStatus("rolled back", f"by push {last.push} itself: {f.why}")
    if last.state is not PushState.KEEP:
        open_ = "" if last.state in TERMINAL else "; the next command that uses the machine finishes it"
        return ProposalStatus("pushed", f"push {last.push} stands at {last.state}{open_}")
    later = [j for n, j in journal.pushes.items() if n > last.push and j[-1].state is PushState.KEEP]
    if not later:
        return ProposalStatus("kept", f"push {last.push}: {f.verify}")
    if facts(later[-1]).image == f.image:
        return ProposalStatus("kept", f"push {last.push} kept it; in force again since push {later[-1][-1].push}")
    number = later[0][-1].push
    if journal.origin(later[0]).kind == KIND:
        return ProposalStatus("rolled back", f"by order of a person with push {number}, after push {last.push} had kept it")
    return ProposalStatus("superseded", f"push {last.push} kept it; push {number} put another table in its place")
