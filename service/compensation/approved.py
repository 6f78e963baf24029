"""Approved proposals that the service may push, and the order to push one. `push_approved` carries it out, and is loaded only then."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass

from abbe.service.compensation.proposal_decisions import proposal_status
from abbe.service.compensation.proposal_doc import load
from abbe.service.domain.progress import ProgressSink
from abbe.service.domain.service_records import AlarmEntryRecord, AlarmKind
from abbe.service.errors import StoreError
from abbe.service.sequences.control import Control
from abbe.service.storage.store import Store
from abbe.service.verification.alarm_states import NO_ALARM

Begun = Callable[[], Awaitable[None]]
"""Called at least once when this process has locked the machine: from then on the push counts as attempted."""


@dataclass(frozen=True, slots=True)
class ApprovedProposal:
    """A proposal that waits for the service: its number, its valid approval, and the alarm that caused it (0: none)."""

    proposal: int
    approval: int
    alarm: int


@dataclass(frozen=True, slots=True)
class PushOrder:
    """One attempt: proposal number, callbacks for its begin and its progress, and the `Control` by which a person may stop it."""

    proposal: int
    begun: Begun
    progress: ProgressSink
    control: Control


def next_approved(store: Store, machine: str, entries: Sequence[AlarmEntryRecord], now_s: float) -> ApprovedProposal | None:
    """The proposal that was approved last, if the service has not tried it with this approval; None: nothing waits.

    Older approved proposals are not tried in its place: the last approval supersedes them.
    """
    tried = {e.facts.approval for e in entries if e.kind == AlarmKind.PUSHING}
    asked = {e.facts.proposal: e.alarm for e in entries if e.kind == AlarmKind.PROPOSED}
    given = [(rows[-1].id, record.id) for record in store.proposals.all(machine) if (rows := store.proposals.approvals(record.id))]
    if not given:
        return None
    approval, number = max(given)
    try:
        word = proposal_status(store, number, load(store, number), now_s).word
    except StoreError:  # a changed row: its page reports it, and it is never pushed
        return None
    if word == "approved" and approval not in tried:
        return ApprovedProposal(number, approval, asked.get(number, NO_ALARM))
    return None
