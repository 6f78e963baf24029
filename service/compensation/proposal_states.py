"""Where a proposal stands, from what is written down: its row, its approvals, and the push journal. Nothing of it is kept twice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from abbe.service.clock import Clock
from abbe.service.compensation.proposal_checks import approve, reject, valid_approval
from abbe.service.compensation.proposal_doc import Proposed, load
from abbe.service.domain.decisions import ProposalApproval, ProposalRejection
from abbe.service.errors import TableRefused
from abbe.service.push.book import read_entries
from abbe.service.push.entries import Journal, JournalEntry, facts
from abbe.service.push.states import TERMINAL, PushState
from abbe.service.storage.store import Store
from abbe.service.tables.push_history import KIND, pushes_of


@dataclass(frozen=True, slots=True)
class ProposalStatus:
    """One word and one sentence. Words: refused, rejected, proposed, approved, expired, superseded, pushed, kept, rolled back."""

    word: str
    text: str


def proposal_status(store: Store, number: int, proposed: Proposed, now_s: float) -> ProposalStatus:
    """Where a stored proposal stands."""
    entries = read_entries(store, proposed.candidate.machine)
    docs = {t.id: t.doc for t in store.tables.all()}
    return status_of_proposal(number, proposed, store.proposals.approvals(number), entries, docs, now_s, store.proposals.rejections(number))


def status_of_proposal(
    number: int,
    proposed: Proposed,
    approvals: list[ProposalApproval],
    entries: list[JournalEntry],
    docs: dict[int, dict[str, Any]],
    now_s: float,
    rejections: Sequence[ProposalRejection] = (),
) -> ProposalStatus:
    """The same from plain values; ``docs``: of the store's tables, by number."""
    journals = pushes_of(entries)
    own = [j for j in journals.values() if docs.get(int(facts(j)["table"]), {}).get("proposal") == number]
    if own:
        found = _pushed(own[-1], journals, docs)
        if found is not None:
            return found
    if rejections:
        return ProposalStatus("rejected", f"by {rejections[-1].name}: {rejections[-1].reason}")
    if proposed.reasons:
        return ProposalStatus("refused", f"{len(proposed.reasons)} reasons against it when it was proposed")
    wrote = [e.push for e in entries if e.state is PushState.STAGING and e.utc > proposed.utc]
    if wrote:
        return ProposalStatus("superseded", f"push {wrote[-1]} wrote into the controller since it was proposed")
    if now_s >= proposed.valid_until_s:
        return ProposalStatus("expired", f"its measurement is older than {proposed.limits.age_h:g} h")
    approval, why = valid_approval(proposed, approvals, now_s, two_people=proposed.two_people)
    if approval is not None:
        return ProposalStatus("approved", f"by {approval.name} until {approval.expiry}")
    return ProposalStatus("proposed", why if approvals or proposed.two_people else "waits for a push")


def _pushed(own: Journal, journals: dict[int, Journal], docs: dict[int, dict[str, Any]]) -> ProposalStatus | None:
    """How its last push ended; None if it came to nothing before the new table was in force."""
    last, f = own[-1], facts(own)
    if last.state in (PushState.REJECTED, PushState.ABORTED):
        return None
    if last.state is PushState.ROLLED_BACK:
        return ProposalStatus("rolled back", f"by push {last.push} itself: {f.get('why', '')}")
    if last.state is not PushState.KEEP:
        open_ = "" if last.state in TERMINAL else "; the next command that uses the machine finishes it"
        return ProposalStatus("pushed", f"push {last.push} stands at {last.state}{open_}")
    later = [j for n, j in journals.items() if n > last.push and j[-1].state is PushState.KEEP]
    if not later:
        return ProposalStatus("kept", f"push {last.push}: {f.get('verify', '')}")
    if facts(later[-1])["image"] == f["image"]:
        return ProposalStatus("kept", f"push {last.push} kept it; in force again since push {later[-1][-1].push}")
    number = later[0][-1].push
    back = docs.get(int(facts(later[0])["table"]), {}).get("kind") == KIND
    if back:
        return ProposalStatus("rolled back", f"by order of a person with push {number}, after push {last.push} had kept it")
    return ProposalStatus("superseded", f"push {last.push} kept it; push {number} put another table in its place")


def check_waiting(store: Store, number: int, proposed: Proposed, now_s: float) -> None:
    """Only what still waits for a push can be approved.

    Raises
    ------
    TableRefused
        Where it stands instead.
    """
    now = proposal_status(store, number, proposed, now_s)
    if now.word not in ("proposed", "approved", "refused"):  # what speaks against a refused one is told by `approve`
        raise TableRefused(f"proposal {number} is {now.word}: {now.text}", "propose again")


def approve_waiting(store: Store, number: int, name: str, hours: float, clock: Clock, account: str | None = None) -> ProposalApproval:
    """Approve a proposal that still waits for a push; parameters and errors as of `approve`, and TableRefused where it does not wait."""
    proposed = load(store, number)
    check_waiting(store, number, proposed, clock.utc().timestamp())
    return approve(store, number, proposed, name, hours, clock, account)


def reject_waiting(store: Store, number: int, name: str, reason: str, clock: Clock, account: str | None = None) -> ProposalRejection:
    """Reject a proposal that still waits for a push; parameters and errors as of `reject`, and TableRefused where it does not wait."""
    check_waiting(store, number, load(store, number), clock.utc().timestamp())
    return reject(store, number, name, reason, account)
