"""Rollback to the table that was in force before the push, as a pure function of the journal and of the state of the controller.

The process that began the push or any later process runs the rollback. It may be interrupted anywhere, also by a crash, and run again.
"""

from __future__ import annotations

from abbe.drivers.api import BankState
from abbe.service.domain.document import Doc
from abbe.service.domain.push_entry import PushState
from abbe.service.push.journal import PushFacts
from abbe.service.push.operations import (
    BACK,
    BRACKETS,
    Coherent,
    Failed,
    Image,
    Operation,
    OperationKind,
    OperationRefused,
    PushKnowledge,
    Truth,
    bracket,
    stage,
)

MAX_UNANSWERED = 3
BACKS = 3
LEASES = 6
"""Limit of lease commands since the last journal entry: a controller may answer each of them and never give the lease."""
OWNERS = 0xFFFF
"""Number of owner ids of one push: the first is for the push itself, a higher one for each lease of the rollback."""


def record(state: PushState, **doc: object) -> Operation:
    """Return the operation that writes a journal entry."""
    return Operation(OperationKind.RECORD, state=state, doc=doc)


def in_force(f: PushFacts, truth: Truth) -> str:
    """Table in force by the reported CRC: ``"base"`` (the old one), ``"candidate"`` (the new one), ``"neither"``; or ``"off"``: none."""
    if truth.states[truth.active] is BankState.OFF:
        return "off"
    crc = truth.crc[truth.active]
    if truth.states[truth.active] is BankState.SEALED and crc in (f.base_crc, f.crc):
        return "base" if crc == f.base_crc else "candidate"
    return "neither"


def mismatch_doc(f: PushFacts, truth: Truth) -> Doc:
    """Return the state that the journal expects and the state that the controller reports, for a person to compare."""
    reported = {"boot": truth.boot, "gen": truth.gen, "active": truth.active, "crc": list(truth.crc), "states": list(truth.states)}
    return {"expected": {"base_crc": f.base_crc, "crc": f.crc}, "controller": reported}


def go_back(f: PushFacts, known: PushKnowledge, state: PushState, seq: int) -> Operation:
    """Next operation of a rollback.

    ``state``: state of the last entry: ROLLBACK, RESTAGING, ACTIVATING_BACK or ROLLBACK_PENDING. ``seq``: number of the last entry;
    it gives each lease of the rollback a higher owner id than the one before.
    """
    if known.rested:
        return Operation(OperationKind.END, text="the rollback is blocked now")
    if known.unanswered >= MAX_UNANSWERED:
        return _pending(state, "the controller does not answer")
    if state is PushState.ACTIVATING_BACK and known.wrote_last and not known.asked:
        return Operation(OperationKind.ACTIVATE, bank=f.back_bank, crc=f.base_crc, gen=f.back_gen, owner=known.lease, text=BACK)
    if known.start is None:
        return Operation(OperationKind.LOOK, mark=True)
    which = in_force(f, known.start)
    if which == "base":
        return _arrived(f, known)
    if which == "neither":
        return record(PushState.OPERATOR, why="the active table is neither the old nor the new one", **mismatch_doc(f, known.start))
    return _switch(f, known, state, seq)


def _arrived(f: PushFacts, known: PushKnowledge) -> Operation:
    assert known.start is not None
    step = bracket(known, known.start.active, len(f.base_image) // 2, again=False)
    if isinstance(step, Operation):
        return step
    if step is not None and known.image == f.base_image:
        return record(PushState.ROLLED_BACK, bank=step.truth.active)
    if known.brackets < BRACKETS:
        return Operation(OperationKind.LOOK, mark=True)
    return record(PushState.OPERATOR, why="the active bank has the old table's CRC but other content", **mismatch_doc(f, known.start))


def _switch(f: PushFacts, known: PushKnowledge, state: PushState, seq: int) -> Operation:
    """Bring the old table back: the new table is active, or an exchange was interrupted and no table acts."""
    truth = known.start
    assert truth is not None
    if truth.unsafe:
        return _pending(state, f"not safe now: {truth.unsafe}")
    if truth.states[1 - truth.active] is BankState.LAID_ASIDE and truth.crc[1 - truth.active] == f.base_crc:
        return _pending(state, "the old table acts after the control's next start: restart the control, and move nothing before")
    if state is PushState.ACTIVATING_BACK:
        text = known.verdict.text if isinstance(known.verdict, OperationRefused) else "the activation of the old table did not happen"
        return _pending(state, text) if known.backs >= BACKS else record(PushState.ROLLBACK, again=text)
    if state is PushState.ROLLBACK_PENDING:
        return (
            record(PushState.ROLLBACK, again="the rollback is no longer blocked")
            if _lease_open(f, truth)
            else _pending(state, "another owner has the lease")
        )
    if not known.lease or truth.owner != known.lease:
        return _lease(f, known, truth, state, seq)
    if state is PushState.RESTAGING:
        return _restage(f, known, truth, state)
    return _with_table_off(f, known, truth) if in_force(f, truth) == "off" else _with_old_bank(f, known, truth)


def _lease_open(f: PushFacts, truth: Truth) -> bool:
    return truth.owner == 0 or f.owner <= truth.owner <= f.owner + OWNERS


def _lease(f: PushFacts, known: PushKnowledge, truth: Truth, state: PushState, seq: int) -> Operation:
    if isinstance(known.verdict, OperationRefused) or not _lease_open(f, truth):
        return _pending(state, "another owner has the lease")
    if known.leases + known.releases >= LEASES:
        return _pending(state, "the controller answers, but does not give or take the lease")
    if truth.owner:  # an earlier lease of this push: release it first, even if another process holds it
        return Operation(OperationKind.RELEASE, owner=truth.owner)
    return Operation(OperationKind.LEASE, owner=f.owner + 1 + seq)


def _with_old_bank(f: PushFacts, known: PushKnowledge, truth: Truth) -> Operation:
    """Activate the old table from its bank, or restore it from the journal if the controller lost it; never overwrite foreign content."""
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
    if f.restaged:  # an earlier rollback of this push was interrupted: the bank may hold its chunks
        step = bracket(known, other, len(base) // 2, again=False)
        if isinstance(step, Operation):
            return step
        if step is None and known.brackets < BRACKETS:
            return Operation(OperationKind.LOOK, mark=True)
        if step is not None and _ours(known.image or b"", base, 2 * f.chunk_words):
            return _begin_restaging(step.truth, other)
    return record(
        PushState.OPERATOR,
        why="the old table is no longer in its bank: another program overwrote it",
        **mismatch_doc(f, truth),
    )


def _with_table_off(f: PushFacts, known: PushKnowledge, truth: Truth) -> Operation:
    """Restore the old table of a control with one table after an interrupted exchange, unless its table holds foreign content."""
    step = bracket(known, truth.active, min(len(f.image), len(f.base_image)) // 2, again=False)
    if isinstance(step, Operation):
        return step
    if step is not None and _mixed(known.image or b"", (f.image, f.base_image), 2 * f.chunk_words):
        return _begin_restaging(step.truth, 1 - truth.active)
    if known.brackets < BRACKETS:
        return Operation(OperationKind.LOOK, mark=True)
    why = "compensation is off, and its table was changed by another program or a person"
    return record(PushState.OPERATOR, why=why, **mismatch_doc(f, truth))


def _mixed(content: bytes, images: tuple[bytes, bytes], size: int) -> bool:
    """Whether each chunk of a table equals the same chunk of the new or of the old table."""
    return bool(content) and all(
        content[at : at + size] in [i[: len(content)][at : at + size] for i in images] for at in range(0, len(content), size)
    )


def _armed(truth: Truth, bank: int, state: PushState) -> Operation:
    if truth.unsafe:
        return _pending(state, f"not safe now: {truth.unsafe}")
    return record(PushState.ACTIVATING_BACK, back_bank=bank, back_gen=truth.gen)


def _begin_restaging(truth: Truth, bank: int) -> Operation:
    return record(PushState.RESTAGING, restaged=True, back_bank=bank, restage_gen=truth.gen, restage_boot=truth.boot)


def _ours(content: bytes, base: bytes, size: int) -> bool:
    """Whether each chunk of a bank equals the same chunk of the old table or is still blank (zeros)."""
    chunks = [(content[at : at + size], base[at : at + size]) for at in range(0, len(base), size)]
    return len(content) == len(base) and all(is_ == wanted or not any(is_) for is_, wanted in chunks)


def _restage(f: PushFacts, known: PushKnowledge, truth: Truth, state: PushState) -> Operation:
    if not known.wrote_last:  # the progress of an earlier process is unknown: restart with the present generation
        return record(PushState.ROLLBACK, again="restoring the old table was interrupted")
    image = Image(
        f.back_bank, f.base_image, f.base_crc, "", known.lease,
        f.restage_gen, f.restage_boot, f.crc if in_force(f, truth) != "off" else 0, f.chunk_words,
    )  # fmt: skip
    step = stage(image, known)
    if isinstance(step, Coherent) and in_force(f, step.truth) == "off" and step.truth.gen != f.restage_gen:
        return record(PushState.ROLLBACK, again="the table that is switched off was changed meanwhile")
    if isinstance(step, Coherent):
        return _armed(step.truth, image.bank, state)
    if isinstance(step, Failed):
        return record(PushState.OPERATOR, why=step.why, **mismatch_doc(f, truth)) if step.foreign else _pending(state, step.why)
    return step


def _pending(state: PushState, why: str) -> Operation:
    if state is PushState.ROLLBACK_PENDING:
        return Operation(OperationKind.END, text=why)
    return record(PushState.ROLLBACK_PENDING, pending=why)
