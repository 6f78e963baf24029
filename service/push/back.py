"""The way back to the table that was in force before, and what a crash during it leaves: a pure function of journal and truth.

It is taken by the process that began the push and by any later one; it may be broken off anywhere and begun again.
"""

from __future__ import annotations

from abbe.drivers.api import BankState
from abbe.service.push.entries import Doc, PushFacts
from abbe.service.push.learn import BACK
from abbe.service.push.operations import Knowledge, Operation, OperationKind, Refused, Truth
from abbe.service.push.staging import BRACKETS, Coherent, Failed, Image, bracket, stage
from abbe.service.push.states import PushState

DOUBTS = 3
BACKS = 3
LEASES = 6
"""Commands about the lease since the last entry: on a controller that answers and does nothing, this is no way to wait."""
OWNERS = 0xFFFF
"""Owner ids of one push: the first for the way forward, a higher one for every lease on the way back."""


def record(state: PushState, **doc: object) -> Operation:
    """The operation that writes a journal entry."""
    return Operation(OperationKind.RECORD, state=state, doc=doc)


def in_force(f: PushFacts, truth: Truth) -> str:
    """Which table is active: ``"base"``, ``"candidate"`` or ``"neither"``, by the CRC that the controller states."""
    crc = truth.crc[truth.active]
    if truth.states[truth.active] is BankState.SEALED and crc in (f.base_crc, f.crc):
        return "base" if crc == f.base_crc else "candidate"
    return "neither"


def seen(f: PushFacts, truth: Truth) -> Doc:
    """What a person needs to compare: what the journal knows and what the controller says."""
    says = {"boot": truth.boot, "gen": truth.gen, "active": truth.active, "crc": list(truth.crc), "states": list(truth.states)}
    return {"expected": {"base_crc": f.base_crc, "crc": f.crc}, "controller": says}


def go_back(f: PushFacts, known: Knowledge, state: PushState, seq: int) -> Operation:
    """Next operation on the way back.

    Parameters
    ----------
    f : PushFacts
        What the journal says.
    known : Knowledge
        What this process knows.
    state : PushState
        Last state: ROLLBACK, RESTAGING, ACTIVATING_BACK or ROLLBACK_PENDING.
    seq : int
        Number of the last entry; every lease on the way back has a higher owner id than those before.
    """
    if known.rested:
        return Operation(OperationKind.END, text="the way back is not open now")
    if known.doubts >= DOUBTS:
        return _pending(state, "the controller does not answer")
    if state is PushState.ACTIVATING_BACK and known.wrote_last and not known.asked:
        return Operation(OperationKind.ACTIVATE, bank=f.back_bank, crc=f.base_crc, gen=f.back_gen, owner=known.lease, text=BACK)
    if known.start is None:
        return Operation(OperationKind.LOOK, mark=True)
    which = in_force(f, known.start)
    if which == "base":
        return _arrived(f, known)
    if which == "neither":
        return record(PushState.OPERATOR, why="the active table is neither the old nor the new one", **seen(f, known.start))
    return _switch(f, known, state, seq)


def _arrived(f: PushFacts, known: Knowledge) -> Operation:
    assert known.start is not None
    step = bracket(known, known.start.active, len(f.base_image) // 2, again=False)
    if isinstance(step, Operation):
        return step
    if step is not None and known.image == f.base_image:
        return record(PushState.ROLLED_BACK, bank=step.truth.active)
    if known.brackets < BRACKETS:
        return Operation(OperationKind.LOOK, mark=True)
    return record(PushState.OPERATOR, why="the active bank has the old table's CRC and another content", **seen(f, known.start))


def _switch(f: PushFacts, known: Knowledge, state: PushState, seq: int) -> Operation:
    """The new table is active and has to go."""
    truth = known.start
    assert truth is not None
    if truth.unsafe:
        return _pending(state, f"not safe now: {truth.unsafe}")
    if truth.states[1 - truth.active] is BankState.LAID_ASIDE and truth.crc[1 - truth.active] == f.base_crc:
        return _pending(state, "the old table acts after the control's next start: start it anew, and move nothing before")
    if state is PushState.ACTIVATING_BACK:
        text = known.verdict.text if isinstance(known.verdict, Refused) else "the activation of the old table did not happen"
        return _pending(state, text) if known.backs >= BACKS else record(PushState.ROLLBACK, again=text)
    if state is PushState.ROLLBACK_PENDING:
        return (
            record(PushState.ROLLBACK, again="the way back is open again")
            if _lease_open(f, truth)
            else _pending(state, "leased by another")
        )
    if not known.lease or truth.owner != known.lease:
        return _lease(f, known, truth, state, seq)
    if state is PushState.RESTAGING:
        return _restage(f, known, truth, state)
    return _with_old_bank(f, known, truth)


def _lease_open(f: PushFacts, truth: Truth) -> bool:
    return truth.owner == 0 or f.owner <= truth.owner <= f.owner + OWNERS


def _lease(f: PushFacts, known: Knowledge, truth: Truth, state: PushState, seq: int) -> Operation:
    if isinstance(known.verdict, Refused) or not _lease_open(f, truth):
        return _pending(state, "another owner has the lease")
    if known.leases + known.releases >= LEASES:
        return _pending(state, "the controller answers, but does not give or take the lease")
    if truth.owner:  # of this push, from before: it is shut out first, also where another process holds it
        return Operation(OperationKind.RELEASE, owner=truth.owner)
    return Operation(OperationKind.LEASE, owner=f.owner + 1 + seq)


def _with_old_bank(f: PushFacts, known: Knowledge, truth: Truth) -> Operation:
    """Use the old table where it still stands, restore it from the journal where the controller lost it, never over a person's work."""
    other, base = 1 - truth.active, f.base_image
    if truth.states[other] is BankState.SEALED and truth.crc[other] == f.base_crc:
        step = bracket(known, other, len(base) // 2, again=False)
        if isinstance(step, Operation):
            return step
        if step is not None and known.image == base:
            return _armed(step.truth, other, PushState.ROLLBACK)
        if known.brackets < BRACKETS:
            return Operation(OperationKind.LOOK, mark=True)
    if truth.states[other] is BankState.EMPTY:  # the controller forgot it
        return _begin_restaging(truth, other)
    if f.restaged:  # by this push, which was interrupted: what stands there may be ours
        step = bracket(known, other, len(base) // 2, again=False)
        if isinstance(step, Operation):
            return step
        if step is None and known.brackets < BRACKETS:
            return Operation(OperationKind.LOOK, mark=True)
        if step is not None and _ours(known.image or b"", base, 2 * f.chunk_words):
            return _begin_restaging(step.truth, other)
    return record(PushState.OPERATOR, why="the old table is no longer in its bank, and somebody else put there what is", **seen(f, truth))


def _armed(truth: Truth, bank: int, state: PushState) -> Operation:
    if truth.unsafe:
        return _pending(state, f"not safe now: {truth.unsafe}")
    return record(PushState.ACTIVATING_BACK, back_bank=bank, back_gen=truth.gen)


def _begin_restaging(truth: Truth, bank: int) -> Operation:
    return record(PushState.RESTAGING, restaged=True, back_bank=bank, restage_gen=truth.gen, restage_boot=truth.boot)


def _ours(held: bytes, base: bytes, size: int) -> bool:
    """Whether a bank holds nothing but chunks of the old table, and nothing where they are missing."""
    chunks = [(held[at : at + size], base[at : at + size]) for at in range(0, len(base), size)]
    return len(held) == len(base) and all(is_ == wanted or not any(is_) for is_, wanted in chunks)


def _restage(f: PushFacts, known: Knowledge, truth: Truth, state: PushState) -> Operation:
    if not known.wrote_last:  # how far an earlier process came is not known: again from the beginning, with the generation of now
        return record(PushState.ROLLBACK, again="restoring the old table was interrupted")
    image = Image(
        f.back_bank, f.base_image, f.base_crc, f.base_meaning, known.lease,
        f.restage_gen, f.restage_boot, f.crc, f.chunk_words,
    )  # fmt: skip
    step = stage(image, known)
    if isinstance(step, Coherent):
        return _armed(step.truth, image.bank, state)
    if isinstance(step, Failed):
        return record(PushState.OPERATOR, why=step.why, **seen(f, truth)) if step.foreign else _pending(state, step.why)
    return step


def _pending(state: PushState, why: str) -> Operation:
    if state is PushState.ROLLBACK_PENDING:
        return Operation(OperationKind.END, text=why)
    return record(PushState.ROLLBACK_PENDING, pending=why)
