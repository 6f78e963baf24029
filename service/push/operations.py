"""Operations of the push machine, their outcomes, and the knowledge of a process about the controller. Plain values, no I/O.

`stage` is the sequence that push and rollback share: it writes an image into the inactive bank chunk by chunk, seals it, and reads it back
twice in full.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any, NamedTuple

from abbe.drivers.api import BankState
from abbe.service.domain.document import Doc
from abbe.service.domain.push_entry import PushState


class OperationKind(Enum):
    """Operations of the protocol. Only WRITE, SEAL, ACTIVATE, LEASE and RELEASE change anything in the controller."""

    LOOK = "look"
    """Read the coherent status: boot id, generation, active bank, CRCs, lease, interlocks. Value: `Truth`."""
    READ = "read"
    """Read a bank in full. Value: its bytes."""
    READ_AGAIN = "read again"
    """Read a bank in full once more and decode it independently. Value: its semantic digest."""
    VALIDATE = "validate"
    """Check the table without touching the controller. Value: list of reasons against it."""
    APPROVE = "approve"
    """Ask for the approval. Value: `Approval`."""
    LEASE = "lease"
    RELEASE = "release"
    WRITE = "write"
    """Write one chunk of a bank."""
    READ_CHUNK = "read chunk"
    """Read one chunk back. Value: its bytes."""
    SEAL = "seal"
    ACTIVATE = "activate"
    """Make a bank the active one by compare-and-swap on its CRC and the generation. Sent at most once per journal entry."""
    PROBE = "probe"
    """Move to a few points and prove sign, axis and unit physically. Value: `VerificationResult`."""
    VERIFY = "verify"
    """Measure again and compare with before. Value: `VerificationResult`."""
    RECORD = "record"
    """Write a journal entry to disk before anything else happens."""
    END = "end"
    """Nothing more to do now."""


@dataclass(frozen=True, slots=True)
class Operation:
    """One operation. Fields that a kind does not need keep their defaults.

    ``first``, ``count``: registers; ``data``: bytes to write or to expect; ``mark``: this LOOK opens a bracket of reads (`bracket`).
    """

    kind: OperationKind
    bank: int = -1
    first: int = 0
    count: int = 0
    data: bytes = b""
    crc: int = 0
    gen: int = 0
    owner: int = 0
    mark: bool = False
    state: PushState | None = None
    doc: Doc | None = None
    text: str = ""


@dataclass(frozen=True, slots=True)
class Truth:
    """State of the controller from one coherent read.

    ``crc``: CRC of each bank, 0 for a bank that is not sealed. ``unsafe``: why nothing may be activated now, empty if no interlock is
    open and nothing moves. ``still_s``: how long the axes have stood. ``now_s``: monotonic host time.
    """

    boot: int
    gen: int
    active: int
    crc: tuple[int, int]
    states: tuple[BankState, BankState]
    owner: int
    lease_ms: int
    unsafe: str
    still_s: float
    now_s: float
    map: str = ""


@dataclass(frozen=True, slots=True)
class Approval:
    """Consent of a person (or of the policy) to exactly one table on exactly one base.

    ``digest``: digest of the approved content (`abbe.service.push.journal.approval_digest`). ``expiry``: when the approval ends, UTC as
    text, part of the digest. ``until_s``: the same in monotonic host time, because the wall clock can be set.
    """

    digest: str
    by: str
    expiry: str
    until_s: float


@dataclass(frozen=True, slots=True)
class VerificationResult:
    """Outcome of a probe or of a verification."""

    passed: bool
    text: str


@dataclass(frozen=True, slots=True)
class Done:
    """The controller, or the actor who was asked, confirmed the operation."""

    value: Any = None


@dataclass(frozen=True, slots=True)
class OperationRefused:
    """The operation was understood and refused: nothing changed."""

    text: str


@dataclass(frozen=True, slots=True)
class Unanswered:
    """No valid answer: the operation may have happened, or not, or still happen."""

    text: str


Outcome = Done | OperationRefused | Unanswered


class PushKnowledge(NamedTuple):
    """Knowledge of a process since its start or the last journal entry; a crash loses all of it.

    A process that did not begin the push (``mine`` false) knows nothing, and this alone makes the push machine recover. It is a plain tuple
    for speed: the tests of all faults create millions of them.

    Parameters
    ----------
    mine : bool
        This process began the push.
    truth : Truth, optional
        The last look, if nothing has happened since that could have changed it.
    start : Truth, optional
        The look that opened the present bracket of reads (`bracket`).
    image, decoded_digest : bytes, str, optional
        What was read within the bracket.
    brackets : int
        Brackets opened since the last entry.
    chunk, wrote, differs, unsure : int, bool, bool, bool
        Number of chunks written and read back. Of the present chunk: whether it was written, was read back with other content, and whether
        its write got no valid answer.
    written, rewrites, rewrites_here : int
        Writes that certainly happened since the last journal entry; repeated writes in total, and of the present chunk.
    sealed : int
        Number of SEAL commands.
    asked : bool
        Whether the one activation that the last entry permits was sent.
    lease, leases, releases, fenced : int, int, int, bool
        Owner id of the requested lease (0: none). Since the last entry: number of requests and of releases, and whether a release shut out
        late commands of the old owner.
    forgets : int
        Writes since the last entry that make a control discard a table that it laid aside.
    verdict : Done, Refused or Unanswered, optional
        Answer to the last question (validate, approve, probe, verify).
    unanswered : int
        Consecutive operations without a valid answer.
    backs : int
        Activations of the old table that this process has sent.
    approved_until_s : float
        Monotonic time at which the approval ends.
    wrote_last : bool
        This process wrote the last journal entry, so no other process can have done the operation that the entry permits.
    rested : bool
        This process has just recorded that the rollback is blocked, and does not retry by itself.
    stop : str
        Why a person or the service stops the push, or why the push is given up; empty while it continues.
    """

    mine: bool = False
    truth: Truth | None = None
    start: Truth | None = None
    image: bytes | None = None
    decoded_digest: str | None = None
    brackets: int = 0
    chunk: int = 0
    wrote: bool = False
    differs: bool = False
    unsure: bool = False
    written: int = 0
    rewrites: int = 0
    rewrites_here: int = 0
    sealed: int = 0
    asked: bool = False
    lease: int = 0
    leases: int = 0
    releases: int = 0
    forgets: int = 0
    fenced: bool = False
    verdict: Outcome | None = None
    unanswered: int = 0
    backs: int = 0
    approved_until_s: float = 0.0
    wrote_last: bool = False
    rested: bool = False
    stop: str = ""


_QUESTIONS = frozenset({OperationKind.VALIDATE, OperationKind.APPROVE, OperationKind.PROBE, OperationKind.VERIFY})


def after_record(known: PushKnowledge, state: PushState) -> PushKnowledge:
    """Knowledge after a journal entry: forget the controller's state, keep what concerns this process."""
    return PushKnowledge(
        mine=known.mine,
        lease=known.lease,
        backs=known.backs,
        approved_until_s=known.approved_until_s,
        stop=known.stop,
        wrote_last=True,
        rested=state is PushState.ROLLBACK_PENDING,
    )


def learn(known: PushKnowledge, op: Operation, outcome: Outcome) -> PushKnowledge:
    """Knowledge after the ``outcome`` of ``op``, which is neither RECORD nor END."""
    known = known._replace(unanswered=known.unanswered + 1 if isinstance(outcome, Unanswered) else 0)
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


def _looked(known: PushKnowledge, op: Operation, outcome: Outcome) -> PushKnowledge:
    if not isinstance(outcome, Done) or not isinstance(outcome.value, Truth):
        return known
    if op.mark:
        return known._replace(start=outcome.value, truth=None, image=None, decoded_digest=None, brackets=known.brackets + 1)
    return known._replace(truth=outcome.value)


def _read(known: PushKnowledge, op: Operation, outcome: Outcome) -> PushKnowledge:
    if isinstance(outcome, Unanswered):
        return known
    done = isinstance(outcome, Done)
    if op.kind is OperationKind.READ:
        return known._replace(image=outcome.value if isinstance(outcome, Done) else b"", truth=None)
    return known._replace(decoded_digest=str(outcome.value) if done and isinstance(outcome, Done) else "unreadable", truth=None)


def _chunk(known: PushKnowledge, op: Operation, outcome: Outcome) -> PushKnowledge:
    if op.kind is OperationKind.WRITE and op.text == FORGET:
        return known._replace(forgets=known.forgets + 1, wrote=True, truth=None)
    if op.kind is OperationKind.WRITE:
        if isinstance(outcome, OperationRefused):
            return known._replace(verdict=outcome, wrote=True, truth=None)
        again = int(known.differs)
        unsure = isinstance(outcome, Unanswered)
        known = known._replace(rewrites=known.rewrites + again, rewrites_here=known.rewrites_here + again, truth=None)
        return known._replace(wrote=True, differs=False, unsure=unsure, written=known.written + (not unsure))
    if isinstance(outcome, Unanswered):
        return known
    if isinstance(outcome, Done) and outcome.value == op.data:
        written = known.written + int(known.unsure)
        return known._replace(chunk=known.chunk + 1, wrote=False, differs=False, unsure=False, written=written, rewrites_here=0)
    return known._replace(differs=True, unsure=False, truth=None)


def _commanded(known: PushKnowledge, op: Operation, outcome: Outcome) -> PushKnowledge:
    known = known._replace(truth=None, start=None, image=None, decoded_digest=None)
    if op.kind is OperationKind.LEASE:
        lease = known.lease if isinstance(outcome, OperationRefused) else op.owner
        return known._replace(verdict=outcome, lease=lease, leases=known.leases + 1)
    if op.kind is OperationKind.RELEASE:  # a refusal means that another owner has it: the old owner is shut out either way
        known = known._replace(releases=known.releases + 1, stop=known.stop or op.text)
        return known if isinstance(outcome, Unanswered) else known._replace(fenced=True, lease=0)
    if op.kind is OperationKind.SEAL:
        return known._replace(sealed=known.sealed + 1, verdict=outcome if isinstance(outcome, OperationRefused) else None)
    return known._replace(asked=True, verdict=outcome, backs=known.backs + int(op.text == BACK))


FORGET = "forget"
"""``text`` of a write that makes a control discard a table that it laid aside."""
BACK = "back"
"""``text`` of an activation of the old table."""


BRACKETS = 4
REWRITES_PER_CHUNK = 2
REWRITES = 5
SEALS = 2


@dataclass(frozen=True, slots=True)
class Image:
    """An image to stage. ``gen``: generation when writing was permitted. ``in_force``: CRC of the table that stays active.

    ``semantic_digest``: empty for bytes that the control itself held: equal bytes have the same meaning.
    """

    bank: int
    data: bytes
    crc: int
    semantic_digest: str
    owner: int
    gen: int
    boot: int
    in_force: int
    chunk_words: int


@dataclass(frozen=True, slots=True)
class Failed:
    """The reason why staging failed. ``foreign``: another program has written into the bank."""

    why: str
    foreign: bool = False


@dataclass(frozen=True, slots=True)
class Coherent:
    """A closed bracket of reads: nothing changed between its first look and its last. ``truth`` is the last look."""

    truth: Truth


def bracket(known: PushKnowledge, bank: int, count: int, *, again: bool) -> Operation | Coherent | None:
    """Next operation of a bracket (a full read between two looks), or its end. None: the two looks differ, so something changed.

    ``count``: registers to read, 0 for the length in the image's header. ``again``: read a second time and decode independently.
    """
    if known.start is None:
        return Operation(OperationKind.LOOK, mark=True)
    if known.image is None:
        return Operation(OperationKind.READ, bank=bank, count=count)
    if again and known.decoded_digest is None:
        return Operation(OperationKind.READ_AGAIN, bank=bank, count=len(known.image) // 2)
    if known.truth is None:
        return Operation(OperationKind.LOOK)
    same = (known.start.boot, known.start.gen, known.start.active) == (known.truth.boot, known.truth.gen, known.truth.active)
    return Coherent(known.truth) if same else None


def stage(image: Image, known: PushKnowledge) -> Operation | Failed | Coherent:
    """Next operation of staging, or its end.

    Coherent: the bank is sealed, and both read-backs within one generation agree in bytes and in meaning.
    """
    if isinstance(known.verdict, OperationRefused):
        return Failed(f"the controller refused: {known.verdict.text}")
    words = len(image.data) // 2
    if known.chunk * image.chunk_words < words:
        return _write_chunk(image, known)
    if not known.sealed:
        return Operation(OperationKind.SEAL, bank=image.bank, owner=image.owner)
    return _read_back(image, known, words)


def _write_chunk(image: Image, known: PushKnowledge) -> Operation | Failed:
    first = known.chunk * image.chunk_words
    data = image.data[2 * first : 2 * (first + image.chunk_words)]
    write = Operation(OperationKind.WRITE, bank=image.bank, first=first, count=len(data) // 2, data=data)
    if not known.wrote:
        return write
    if not known.differs:
        return Operation(OperationKind.READ_CHUNK, bank=image.bank, first=first, count=len(data) // 2, data=data)
    if known.truth is None:
        return Operation(OperationKind.LOOK)
    # Overwrite foreign content only while the generation proves that no other program has written.
    if (known.truth.boot, known.truth.gen) != (image.boot, image.gen + known.written):
        return Failed("another program wrote into the bank, or the controller restarted; the bank was left unchanged", foreign=True)
    if known.rewrites_here >= REWRITES_PER_CHUNK or known.rewrites >= REWRITES:
        return Failed(f"the bank does not hold what was written at register {first}, even after {known.rewrites_here} repeats")
    return write


def _read_back(image: Image, known: PushKnowledge, words: int) -> Operation | Failed | Coherent:
    step = bracket(known, image.bank, words, again=True)
    if isinstance(step, Operation):
        return step
    if step is None:
        return _again(known, "the generation changed while the bank was read back")
    truth = step.truth
    if truth.boot != image.boot:
        return Failed("the controller restarted during staging")
    if truth.crc[1 - image.bank] != image.in_force or truth.active == image.bank:
        return Failed("the table in force changed during staging")
    if truth.states[image.bank] is not BankState.SEALED and known.sealed < SEALS:
        return Operation(OperationKind.SEAL, bank=image.bank, owner=image.owner)
    if known.image != image.data or (image.semantic_digest and known.decoded_digest != image.semantic_digest):
        what = "bytes" if known.image != image.data else "meaning (independent decoder)"
        return _again(known, f"the bank does not hold what was sent: {what}")
    if truth.states[image.bank] is not BankState.SEALED or truth.crc[image.bank] != image.crc:
        return Failed(f"sealed with CRC {truth.crc[image.bank]:08X}, sent {image.crc:08X}")
    return step


def _again(known: PushKnowledge, why: str) -> Operation | Failed:
    return Operation(OperationKind.LOOK, mark=True) if known.brackets < BRACKETS else Failed(why)
