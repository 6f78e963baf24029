"""The push protocol: the next operation as a pure function of the journal and of the process's knowledge of the controller.

The same function is the crash recovery: a process that did not begin the push knows nothing about it, so it activates no new table and
rolls back an unverified one.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable

from abbe.drivers.api import BankState
from abbe.service.domain.push_entry import BEFORE_ACTIVATION, GOING_BACK, TERMINAL, PushState
from abbe.service.push.back import MAX_UNANSWERED, OWNERS, go_back, in_force, mismatch_doc, record
from abbe.service.push.journal import Journal, OperationOrder, PushFacts, facts_to_act_on, objection
from abbe.service.push.operations import (
    BRACKETS,
    FORGET,
    Approval,
    Coherent,
    Done,
    Failed,
    Image,
    Operation,
    OperationKind,
    OperationRefused,
    PushKnowledge,
    Truth,
    VerificationResult,
    bracket,
    stage,
)

STILL_S = 1.0
"""The axes must have stood for this long before anything is staged."""
LEASE_LEFT_MS = 5000
"""Least remaining time of the lease for an activation: with less, it may end between the last look and the activation."""


def next_operation(journal: Journal, known: PushKnowledge, order: OperationOrder | None = None) -> Operation:
    """Decide what to do next.

    ``journal``: all entries of one push, empty before the first; ``known``: everything that this process has learned since its start or
    since the last entry; ``order``: needed only while the journal is empty. The caller does the operation and then calls `learn`; for
    RECORD it writes the entry and calls `after_record` (`abbe.service.push.operations`).
    """
    if not journal:
        return _begin(known, order) if order is not None else Operation(OperationKind.END, text="nothing was begun")
    state, f = journal[-1].state, facts_to_act_on(journal)
    if state in TERMINAL:
        return _leave(f, known)
    if state in GOING_BACK:
        return go_back(f, known, state, journal[-1].seq)
    if state in BEFORE_ACTIVATION:
        why = known.stop if known.mine else "interrupted before activation"
        why = why or ("the controller does not answer" if known.unanswered >= MAX_UNANSWERED else "")
        return _abandon(f, known, state, why) if why else _FORWARD[state](f, known)
    return _AFTER[state](f, known)


def _leave(f: PushFacts, known: PushKnowledge) -> Operation:
    """The push has ended: release its lease, also one left by a process that died after the last entry."""
    if known.unanswered >= MAX_UNANSWERED or known.fenced:
        return Operation(OperationKind.END)
    if known.lease:
        return Operation(OperationKind.RELEASE, owner=known.lease)
    if known.mine:
        return Operation(OperationKind.END)
    if known.truth is None:
        return Operation(OperationKind.LOOK)
    return (
        Operation(OperationKind.RELEASE, owner=known.truth.owner)
        if f.owner <= known.truth.owner <= f.owner + OWNERS
        else Operation(OperationKind.END)
    )


def _begin(known: PushKnowledge, order: OperationOrder) -> Operation:
    """Read the table in force twice, with a look at the controller's state before and after; then record the snapshot."""
    if known.stop or known.unanswered >= MAX_UNANSWERED:
        return Operation(OperationKind.END, text=known.stop or "the controller does not answer")
    active = known.start.active if known.start else 0
    step = bracket(known, active, 0, again=True)
    if isinstance(step, Operation):
        return step
    image = known.image or b""
    if step is None or step.truth.states[active] is not BankState.SEALED or zlib.crc32(image) != step.truth.crc[active]:
        if known.brackets < BRACKETS:
            return Operation(OperationKind.LOOK, mark=True)
        return Operation(OperationKind.END, text="the table in force does not have the CRC that the controller states, or keeps changing")
    truth = step.truth
    base = {"boot": truth.boot, "gen": truth.gen, "map": truth.map, "base_bank": active, "base_crc": truth.crc[active]}
    base |= {"base_image": image.hex(), "base_meaning": known.decoded_digest, "target": 1 - active}
    return record(PushState.SNAPSHOT, **base, **order.doc())


def _abandon(f: PushFacts, known: PushKnowledge, state: PushState, why: str) -> Operation:
    """Give up before activation: release the lease and end. The table in force was never touched."""
    if state not in (PushState.SNAPSHOT, PushState.VALIDATED) and not known.fenced and known.unanswered < 2 * MAX_UNANSWERED:
        return Operation(OperationKind.RELEASE, owner=f.owner, text=why)
    return record(PushState.ABORTED, why=why)


def _validate(f: PushFacts, known: PushKnowledge) -> Operation:
    no = objection(f.level, attended=f.attended)
    if no:
        return record(PushState.REJECTED, reasons=[no])
    if known.verdict is None:
        return Operation(OperationKind.VALIDATE)
    if isinstance(known.verdict, Done):
        reasons = list(known.verdict.value)
        return record(PushState.REJECTED, reasons=reasons) if reasons else record(PushState.VALIDATED)
    return record(PushState.REJECTED, reasons=[known.verdict.text])


def _approve(f: PushFacts, known: PushKnowledge) -> Operation:
    if known.verdict is None:
        return Operation(OperationKind.APPROVE)
    if not isinstance(known.verdict, Done) or not isinstance(known.verdict.value, Approval):
        text = "no answer" if isinstance(known.verdict, Done) else known.verdict.text
        return record(PushState.REJECTED, reasons=[f"not approved: {text}"])
    approval = known.verdict.value
    if approval.digest != f.binding(approval.expiry):
        return record(PushState.REJECTED, reasons=["the approval is for another table, base, machine or limits"])
    return record(PushState.APPROVED, approval=approval.digest, approved_by=approval.by, expiry=approval.expiry)


def _lease(f: PushFacts, known: PushKnowledge) -> Operation:
    if known.verdict is None:
        return Operation(OperationKind.LEASE, owner=f.owner)
    if isinstance(known.verdict, OperationRefused):
        return _abandon(f, known, PushState.APPROVED, f"another owner has the lease: {known.verdict.text}")
    if isinstance(known.verdict, Done):
        return record(PushState.LEASED)
    if known.truth is None:
        return Operation(OperationKind.LOOK)
    if known.truth.owner == f.owner:
        return record(PushState.LEASED)
    return _abandon(f, known, PushState.APPROVED, "the lease could not be taken")


def _precheck(f: PushFacts, known: PushKnowledge) -> Operation:
    truth = known.truth
    if truth is None:
        return Operation(OperationKind.LOOK)
    why = _changed(f, truth, f.gen) or ("the axes have not stood still long enough" if truth.still_s < STILL_S else "")
    if not why and truth.states[f.target] is BankState.LAID_ASIDE:
        why = "a table is laid aside for the control's next start: restart the control, or remove that table first"
    if why:
        return _abandon(f, known, PushState.LEASED, why)
    return record(PushState.STAGING, still_s=truth.still_s)


def _stage(f: PushFacts, known: PushKnowledge) -> Operation:
    image = Image(f.target, f.image, f.crc, f.semantic_digest, f.owner, f.gen, f.boot, f.base_crc, f.chunk_words)
    step = stage(image, known)
    if isinstance(step, Coherent):
        return record(PushState.STAGED, staged_gen=step.truth.gen)
    return _abandon(f, known, PushState.STAGING, step.why) if isinstance(step, Failed) else step


def _arm(f: PushFacts, known: PushKnowledge) -> Operation:
    """The last look before the activation: check everything again."""
    truth = known.truth
    if truth is None:
        return Operation(OperationKind.LOOK)
    why = _changed(f, truth, f.staged_gen)
    if not why and truth.crc[f.target] != f.crc:
        why = "the staged bank changed"
    if not why and truth.now_s >= known.approved_until_s:
        why = "the approval has expired"
    if not why and truth.lease_ms < LEASE_LEFT_MS:
        why = "the lease is about to end"
    if why:
        return _abandon(f, known, PushState.STAGED, why)
    return record(PushState.ACTIVATING, expect_crc=f.crc, expect_gen=f.staged_gen)


def _changed(f: PushFacts, truth: Truth, gen: int) -> str:
    """Return the reason why the snapshot no longer holds; empty if it holds."""
    if truth.boot != f.boot:
        return "the controller restarted"
    if truth.map != f.map:
        return "the controller's register map changed"
    if in_force(f, truth) != "base" or truth.active != f.base_bank:
        return "the table in force is no longer the approved base"
    if truth.gen != gen:
        return "a bank was changed from outside"
    if truth.owner != f.owner:
        return "the lease is lost"
    return f"not safe now: {truth.unsafe}" if truth.unsafe else ""


def _activate(f: PushFacts, known: PushKnowledge) -> Operation:
    """Send the activation once, never again; read its result from the controller."""
    if known.mine and known.wrote_last and not known.asked and not known.stop:
        return Operation(OperationKind.ACTIVATE, bank=f.target, crc=f.expect_crc, gen=f.expect_gen, owner=f.owner)
    if known.mine and known.asked and not known.fenced and not known.stop:
        step = _confirm(f, known)
        if step is not None:
            return step
    return _unconfirmed(f, known)


def _confirm(f: PushFacts, known: PushKnowledge) -> Operation | None:
    """Next operation to confirm that the active table is, byte for byte, the approved one. None: it differs, or this cannot be shown."""
    if known.unanswered >= MAX_UNANSWERED:
        return None
    if known.start is not None and (in_force(f, known.start) != "candidate" or known.start.boot != f.boot):
        return None
    step = bracket(known, f.target, len(f.image) // 2, again=False)
    if isinstance(step, Operation):
        return step
    if step is not None and known.image == f.image:
        return record(PushState.PROBATION, probation_gen=step.truth.gen)
    return Operation(OperationKind.LOOK, mark=True) if known.brackets < BRACKETS else None


def _unconfirmed(f: PushFacts, known: PushKnowledge) -> Operation:
    """Shut out a command that may still be under way, then look which table is in force."""
    if known.unanswered >= 2 * MAX_UNANSWERED:
        return Operation(OperationKind.END, text="the controller does not answer: whether the new table is active is not known")
    if not known.fenced:
        return Operation(OperationKind.RELEASE, owner=f.owner)
    if known.truth is None:
        return Operation(OperationKind.LOOK)
    which = in_force(f, known.truth)
    if which == "base":
        return _not_in_force(f, known, known.truth)
    if which == "off" and isinstance(known.verdict, OperationRefused):
        return record(PushState.ABORTED, why="compensation was switched off at the control; the control holds the old table")
    if which in ("candidate", "off"):
        return record(PushState.ROLLBACK, why=known.stop or "activated, but not confirmed")
    return record(PushState.OPERATOR, why="the active table is neither the old nor the new one", **mismatch_doc(f, known.truth))


def _not_in_force(f: PushFacts, known: PushKnowledge, truth: Truth) -> Operation:
    """End the push: the old table acts. A new table that the control laid aside for its next start is discarded; it would act
    unverified."""
    if truth.states[f.target] is BankState.LAID_ASIDE and truth.crc[f.target] == f.crc:
        return _forget(f, known, truth)
    if known.forgets:
        return record(PushState.ABORTED, why="this control uses a new table only after its next start: it cannot be verified in a push")
    text = known.verdict.text if isinstance(known.verdict, OperationRefused) else "the activation did not happen"
    return record(PushState.ABORTED, why=known.stop or text)


def _forget(f: PushFacts, known: PushKnowledge, truth: Truth) -> Operation:
    """Make the control discard a laid-aside table by writing into its bank; only the holder of the lease may write."""
    if known.forgets >= MAX_UNANSWERED:
        why = "the control has laid the new table aside, would use it after a restart and does not discard it: do not restart the control"
        return record(PushState.OPERATOR, why=why, **mismatch_doc(f, truth))
    if known.lease and truth.owner == known.lease:
        data = f.image[: 2 * f.chunk_words]
        return Operation(OperationKind.WRITE, bank=f.target, count=len(data) // 2, data=data, text=FORGET)
    if truth.owner or known.leases >= MAX_UNANSWERED:
        return Operation(
            OperationKind.END, text="the control would use the new table after its next start, and another owner has the lease"
        )
    return Operation(OperationKind.LEASE, owner=f.owner + 1)  # fenced off, and lower than any lease of a rollback


def _probation(f: PushFacts, known: PushKnowledge) -> Operation:
    return _proved(f, known, OperationKind.PROBE, PushState.PROBED)


def _verify(f: PushFacts, known: PushKnowledge) -> Operation:
    return _proved(f, known, OperationKind.VERIFY, PushState.VERIFIED)


def _proved(f: PushFacts, known: PushKnowledge, question: OperationKind, then: PushState) -> Operation:
    """Have the machine measured (probe or verification); roll back on every answer but a clear yes."""
    why = _why_back(known)
    if why:
        return record(PushState.ROLLBACK, why=why)
    if known.verdict is None:
        truth = known.truth
        if truth is None:
            return Operation(OperationKind.LOOK)
        if (truth.boot, truth.gen) != (f.boot, f.probation_gen) or in_force(f, truth) != "candidate":
            return record(PushState.ROLLBACK, why="the controller restarted, or a table was changed from outside, during probation")
        return record(PushState.ROLLBACK, why=f"not safe now: {truth.unsafe}") if truth.unsafe else Operation(question)
    if isinstance(known.verdict, Done) and isinstance(known.verdict.value, VerificationResult) and known.verdict.value.passed:
        return record(then, **{question.value: known.verdict.value.text})
    verdict = known.verdict
    text = (
        verdict.value.text
        if isinstance(verdict, Done) and isinstance(verdict.value, VerificationResult)
        else getattr(verdict, "text", "no answer")
    )
    return record(PushState.ROLLBACK, why=f"{question.value}: {text}")


def _keep(f: PushFacts, known: PushKnowledge) -> Operation:
    """Confirm again that the table in force is, byte for byte, the approved and verified one."""
    why = _why_back(known)
    if why:
        return record(PushState.ROLLBACK, why=why)
    step = _confirm(f, known)
    if step is None:
        return record(PushState.ROLLBACK, why="the table in force is not the one that was verified")
    if step.state is not PushState.PROBATION:
        return step
    if (step.doc or {}).get("probation_gen") != f.probation_gen:
        return record(PushState.ROLLBACK, why="a table was changed from outside during the verification")
    return record(PushState.KEEP)


def _why_back(known: PushKnowledge) -> str:
    """Return the reason to roll back (a crash, a stop, no answers); empty: go on."""
    if not known.mine:
        return "interrupted before it was verified"
    return known.stop or ("the controller does not answer" if known.unanswered >= MAX_UNANSWERED else "")


_FORWARD: dict[PushState, Callable[[PushFacts, PushKnowledge], Operation]] = {
    PushState.SNAPSHOT: _validate,
    PushState.VALIDATED: _approve,
    PushState.APPROVED: _lease,
    PushState.LEASED: _precheck,
    PushState.STAGING: _stage,
    PushState.STAGED: _arm,
}
_AFTER: dict[PushState, Callable[[PushFacts, PushKnowledge], Operation]] = {
    PushState.ACTIVATING: _activate,
    PushState.PROBATION: _probation,
    PushState.PROBED: _verify,
    PushState.VERIFIED: _keep,
}
