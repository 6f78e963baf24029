"""How an outcome changes the knowledge of a process. Pure."""

from __future__ import annotations

from abbe.service.push.operations import Approval, Done, Doubt, Knowledge, Operation, OperationKind, Outcome, Refused, Truth
from abbe.service.push.states import PushState

_QUESTIONS = frozenset({OperationKind.VALIDATE, OperationKind.APPROVE, OperationKind.PROBE, OperationKind.VERIFY})


def after_record(known: Knowledge, state: PushState) -> Knowledge:
    """Knowledge after a journal entry: what concerns the controller is forgotten, what concerns the process stays."""
    return Knowledge(
        mine=known.mine,
        lease=known.lease,
        backs=known.backs,
        approved_until_s=known.approved_until_s,
        stop=known.stop,
        wrote_last=True,
        rested=state is PushState.ROLLBACK_PENDING,
    )


def learn(known: Knowledge, op: Operation, outcome: Outcome) -> Knowledge:
    """Knowledge after the ``outcome`` of ``op``, which is neither RECORD nor END."""
    known = known._replace(unanswered=known.unanswered + 1 if isinstance(outcome, Doubt) else 0)
    if op.kind is OperationKind.LOOK:
        return _looked(known, op, outcome)
    if op.kind in (OperationKind.READ, OperationKind.READ_AGAIN):
        return _read(known, op, outcome)
    if op.kind in (OperationKind.WRITE, OperationKind.READ_CHUNK):
        return _chunk(known, op, outcome)
    if op.kind in _QUESTIONS:
        until = outcome.value.until_s if isinstance(outcome, Done) and isinstance(outcome.value, Approval) else known.approved_until_s
        return known._replace(verdict=outcome, approved_until_s=until, truth=None)
    return _commanded(known, op, outcome)


def _looked(known: Knowledge, op: Operation, outcome: Outcome) -> Knowledge:
    if not isinstance(outcome, Done) or not isinstance(outcome.value, Truth):
        return known
    if op.mark:
        return known._replace(start=outcome.value, truth=None, image=None, decoded_digest=None, brackets=known.brackets + 1)
    return known._replace(truth=outcome.value)


def _read(known: Knowledge, op: Operation, outcome: Outcome) -> Knowledge:
    if isinstance(outcome, Doubt):
        return known
    done = isinstance(outcome, Done)
    if op.kind is OperationKind.READ:
        return known._replace(image=outcome.value if isinstance(outcome, Done) else b"", truth=None)
    return known._replace(decoded_digest=str(outcome.value) if done and isinstance(outcome, Done) else "unreadable", truth=None)


def _chunk(known: Knowledge, op: Operation, outcome: Outcome) -> Knowledge:
    if op.kind is OperationKind.WRITE and op.text == FORGET:
        return known._replace(forgets=known.forgets + 1, wrote=True, truth=None)
    if op.kind is OperationKind.WRITE:
        if isinstance(outcome, Refused):
            return known._replace(verdict=outcome, wrote=True, truth=None)
        again = int(known.differs)
        unsure = isinstance(outcome, Doubt)
        known = known._replace(rewrites=known.rewrites + again, rewrites_here=known.rewrites_here + again, truth=None)
        return known._replace(wrote=True, differs=False, unsure=unsure, written=known.written + (not unsure))
    if isinstance(outcome, Doubt):
        return known
    if isinstance(outcome, Done) and outcome.value == op.data:
        written = known.written + int(known.unsure)
        return known._replace(chunk=known.chunk + 1, wrote=False, differs=False, unsure=False, written=written, rewrites_here=0)
    return known._replace(differs=True, unsure=False, truth=None)


def _commanded(known: Knowledge, op: Operation, outcome: Outcome) -> Knowledge:
    known = known._replace(truth=None, start=None, image=None, decoded_digest=None)
    if op.kind is OperationKind.LEASE:
        lease = known.lease if isinstance(outcome, Refused) else op.owner
        return known._replace(verdict=outcome, lease=lease, leases=known.leases + 1)
    if op.kind is OperationKind.RELEASE:  # a refusal means that another owner has it: the old owner is shut out either way
        known = known._replace(releases=known.releases + 1, stop=known.stop or op.text)
        return known if isinstance(outcome, Doubt) else known._replace(fenced=True, lease=0)
    if op.kind is OperationKind.SEAL:
        return known._replace(sealed=known.sealed + 1, verdict=outcome if isinstance(outcome, Refused) else None)
    return known._replace(asked=True, verdict=outcome, backs=known.backs + int(op.text == BACK))


FORGET = "forget"
"""Text of a write that makes a control discard a table that it laid aside."""
BACK = "back"
"""Text of an activation of the old table."""
