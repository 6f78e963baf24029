"""The push journal: orders, one chained entry for every transition, the facts that entries state, and the journal in the database.

The journal is also the audit trail: an entry that is changed, removed or swapped breaks the chain. An entry is on disk before the operation
that it permits is done. `Capabilities`: what a control can do, as its commissioning proved.
"""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

from abbe.service.clock import Clock, utc_text
from abbe.service.domain.document import GENESIS, Doc, canonical
from abbe.service.domain.push_entry import FOLLOWS, TERMINAL, PushEntry, PushState
from abbe.service.errors import UnsafeToMove
from abbe.service.storage.store import Store


@dataclass(frozen=True, slots=True)
class OperationOrder:
    """A table to be pushed into a controller.

    Parameters
    ----------
    machine : str
        Name of the machine.
    image : bytes
        The table's bytes as the controller will hold them; ``crc``: their CRC-32.
    semantic_digest : str
        Digest of the corrections, computed from the tables and not from the image (`abbe.service.push.execute`).
    limits : str
        Digest of the limits that the table was checked against.
    owner : int
        Owner id of the lease, u32. Its low 16 bits are 0: they count the later leases of the same push.
    level : int
        Capability level of the controller (`abbe.service.push.journal`).
    attended : bool
        An authorised approver is at the machine.
    chunk_words : int
        Registers of one write, even.
    table : int
        Id of the table in the store; 0 if it is not stored.
    control : str
        Identity of the control (`abbe.service.domain.machine.control_of`); empty: unknown.
    process : dict
        The pushing process (`abbe.service.domain.measured.Owner`): while it lives, no other process recovers.
    """

    machine: str
    image: bytes
    crc: int
    semantic_digest: str
    limits: str
    owner: int
    level: int = 3
    attended: bool = False
    chunk_words: int = 100
    table: int = 0
    control: str = ""
    process: Doc = field(default_factory=dict)

    def doc(self) -> Doc:
        """The document that the journal keeps."""
        return {
            "machine": self.machine,
            "image": self.image.hex(),
            "crc": self.crc,
            "meaning": self.semantic_digest,
            "limits": self.limits,
            "owner": self.owner,
            "level": self.level,
            "attended": self.attended,
            "chunk_words": self.chunk_words,
            "table": self.table,
            "control": self.control,
            "process": self.process,
        }


NO_PUSH = 0
"""Push number of a person's acceptance in a journal that has no push yet."""


class JournalBroken(ValueError):  # noqa: N818 - the name says enough
    """An entry does not follow from the one before it: chain, order or transition are wrong."""


Journal = tuple[PushEntry, ...]


def digest_of(push: int, seq: int, state: PushState, doc: Doc, utc: str, prev: str) -> str:
    """SHA-256 of an entry's content and of the digest before it."""
    return hashlib.sha256(canonical([push, seq, str(state), doc, utc, prev])).hexdigest()


def follow(journal: Journal, push: int, state: PushState, doc: Doc, *, utc: str, head: str, machine: str) -> PushEntry:
    """Make the next entry of a push.

    ``head``: digest of the last entry in the journal, `GENESIS` if there is none; ``machine``: name of the journal.

    Raises
    ------
    JournalBroken
        This state cannot follow.
    """
    last = journal[-1].state if journal else None
    if not _may_follow(push, last, state):
        raise JournalBroken(f"push {push}: {state} cannot follow {last or 'nothing'}")
    seq = len(journal)
    digest = digest_of(push, seq, state, doc, utc, head)
    return PushEntry(machine=machine, push=push, seq=seq, state=state, utc=utc, prev=head, digest=digest, doc=doc)


def _may_follow(push: int, last: PushState | None, state: PushState) -> bool:
    return state in FOLLOWS[last] or (push == NO_PUSH and last is None and state is PushState.ACCEPTED)


def check_chain(entries: Sequence[PushEntry], head: str = GENESIS) -> None:
    """Check all entries of a journal, in the order of writing; ``head``: digest of the entry before the first.

    Raises
    ------
    JournalBroken
        Names the entry that does not follow, or was changed.
    """
    last: dict[int, PushEntry] = {}
    for entry in entries:
        before = last.get(entry.push)
        name = f"push {entry.push}, entry {entry.seq}"
        if entry.prev != head:
            raise JournalBroken(f"{name}: does not follow the entry before it")
        if entry.digest != digest_of(entry.push, entry.seq, entry.state, entry.doc, entry.utc, entry.prev):
            raise JournalBroken(f"{name}: was changed after it was written")
        if entry.seq != (before.seq + 1 if before else 0) or not _may_follow(entry.push, before.state if before else None, entry.state):
            raise JournalBroken(f"{name}: {entry.state} is not allowed after the previous entry of this push")
        last[entry.push], head = entry, entry.digest


NOT_YET = -1
"""Stands for a number that no entry has stated yet. No controller reports it, so every comparison with it fails."""
PUSHED_BY = "; pushed by "
"""Separates approver and pusher in ``approved_by``; without it nobody else was asked, and the only name is that of who pushed."""
BY_ROLLBACK = ": rollback"
"""Follows the account in ``approved_by`` of a rollback."""


@dataclass(frozen=True, slots=True)
class ReportedBanks:
    """Banks as the controller reported them when a person was called: the active one, and the CRC of each."""

    active: int = NOT_YET
    crc: tuple[int, ...] = ()

    @property
    def in_force(self) -> int:
        """CRC of the active bank; `NOT_YET` if nothing was noted."""
        return self.crc[self.active] if self.crc else NOT_YET


@dataclass(frozen=True, slots=True, kw_only=True)
class PushFacts(OperationOrder):
    """Everything that a push's journal states; later entries override earlier ones. Facts by the state whose entry brings them:

    SNAPSHOT: the order; boot id, generation and register map of the controller; bank, CRC, bytes and semantic digest of the table in
    force; the bank ``target`` for the new table. REJECTED: reasons. APPROVED: digest, approver, expiry. STAGED, ACTIVATING, PROBATION:
    generations, and the CRC that the activation expects. PROBED, VERIFIED: the findings. RESTAGING, ACTIVATING_BACK: bank, generation and
    boot id of the rollback. ROLLBACK_PENDING: what blocks it. ROLLED_BACK: the bank of the old table. OPERATOR: the reason, and the
    controller's report. ACCEPTED: the table that a person vouches for.
    """

    boot: int = NOT_YET
    gen: int = NOT_YET
    map: str = ""
    base_bank: int = NOT_YET
    base_crc: int = NOT_YET
    base_image: bytes = b""
    base_semantic_digest: str = ""
    target: int = NOT_YET
    reasons: tuple[str, ...] = ()
    approval: str = ""
    approved_by: str = ""
    expiry: str = ""
    staged_gen: int = NOT_YET
    expect_crc: int = NOT_YET
    expect_gen: int = NOT_YET
    probation_gen: int = NOT_YET
    probe: str = ""
    verify: str = ""
    restaged: bool = False
    back_bank: int = NOT_YET
    back_gen: int = NOT_YET
    restage_gen: int = NOT_YET
    restage_boot: int = NOT_YET
    why: str = ""
    again: str = ""
    pending: str = ""
    bank: int = NOT_YET
    controller: ReportedBanks = field(default_factory=ReportedBanks)
    accepted_bank: int = NOT_YET
    accepted_crc: int = NOT_YET
    by: str = ""

    def binding(self, expiry: str) -> str:
        """The digest that an approval until ``expiry`` must contain (`approval_digest`)."""
        return approval_digest(self.image, base_image=self.base_image, machine=self.machine, limits=self.limits, expiry=expiry)


def _bytes(text: str) -> bytes:
    """Bytes of a hexadecimal text; empty if the text was tampered with."""
    try:
        return bytes.fromhex(text)
    except ValueError:
        return b""


_CONVERTED: dict[str, Callable[[Any], Any]] = {
    "image": _bytes,
    "base_image": _bytes,
    "reasons": tuple,
    "controller": lambda doc: ReportedBanks(doc["active"], tuple(doc["crc"])),
}
_NO_ORDER: Doc = {
    "machine": "",
    "image": b"",
    "crc": NOT_YET,
    "semantic_digest": "",
    "limits": "",
    "owner": NOT_YET,
    "level": NOT_YET,
    "chunk_words": 0,
}
_KEYS = {"semantic_digest": "meaning", "base_semantic_digest": "base_meaning"}
"""Facts that the journal's entries store under another name."""
_FIELDS = tuple((one.name, _KEYS.get(one.name, one.name), _CONVERTED.get(one.name)) for one in fields(PushFacts))
_SNAPSHOT = frozenset({
    "machine", "image", "crc", "meaning", "limits", "owner", "level", "attended", "chunk_words", "boot", "gen", "map",
    "base_bank", "base_crc", "base_image", "base_meaning", "target",
})  # fmt: skip


def facts(journal: Journal) -> PushFacts:
    """Facts of a push from its journal; later entries override earlier ones."""
    return _parsed(_merged(journal))


def facts_to_act_on(journal: Journal) -> PushFacts:
    """Facts that are complete enough to act on a controller.

    Raises
    ------
    JournalBroken
        The SNAPSHOT lacks something that a rollback needs.
    """
    doc = _merged(journal)
    found = _parsed(doc)
    if (missing := _SNAPSHOT - doc.keys()) or not found.image or not found.base_image:
        raise JournalBroken(f"push {journal[-1].push}: its first entry does not say {', '.join(sorted(missing)) or 'which tables'}")
    return found


def _merged(journal: Journal) -> Doc:
    doc: Doc = {}
    for entry in journal:
        doc.update(entry.doc)
    return doc


def _parsed(doc: Doc) -> PushFacts:
    known = {name: doc[key] if convert is None else convert(doc[key]) for name, key, convert in _FIELDS if key in doc}
    return PushFacts(**(_NO_ORDER | known))


def approval_digest(image: bytes, *, base_image: bytes, machine: str, limits: str, expiry: str) -> str:
    """SHA-256 of what an approval permits: exactly this table on exactly this base, for this machine, under these limits, until ``expiry``.

    ``limits``: their digest (`abbe.service.push.validate.PushLimits.digest`).
    """
    return hashlib.sha256(canonical([image.hex(), base_image.hex(), machine, limits, expiry])).hexdigest()


class StoreBook:
    """Journal of the last or of the next push into one control. Open it with `last`, `new` or `for_acceptance`.

    ``machine``: name of the journal (`Store.pushes.chain`): all pushes into one control share it, whatever the machine is called now.
    ``head``: digest of the last entry in it; ``journal``: entries of this push so far.
    """

    def __init__(self, store: Store, machine: str, clock: Clock, push: int, head: str, journal: Journal) -> None:
        self._store, self._machine, self._clock = store, machine, clock
        self._push, self._head, self._journal = push, head, journal

    @classmethod
    async def last(cls, store: Store, machine: str, clock: Clock, control: str = "") -> StoreBook | None:
        """Journal of the last push of a machine's control, or of acceptances before the first push (`NO_PUSH`); None if there is none."""
        chain = await asyncio.to_thread(store.pushes.chain, machine, control)
        return await cls.of_chain(store, chain, clock)

    @classmethod
    async def of_chain(cls, store: Store, chain: str, clock: Clock) -> StoreBook | None:
        """The last push of the journal of this name; None if the journal is empty."""
        entries = await asyncio.to_thread(store.pushes.entries_of, chain)
        if not entries:
            return None
        push = entries[-1].push
        return cls(store, chain, clock, push, entries[-1].digest, tuple(entry for entry in entries if entry.push == push))

    @classmethod
    async def for_acceptance(cls, store: Store, machine: str, clock: Clock, control: str = "") -> StoreBook:
        """Journal for a person's acceptance of the table in force: the journal of the last push, or `NO_PUSH` before the first push."""
        chain = await asyncio.to_thread(store.pushes.chain, machine, control)
        return await cls.of_chain(store, chain, clock) or cls(store, chain, clock, NO_PUSH, GENESIS, ())

    @classmethod
    async def new(cls, store: Store, machine: str, clock: Clock, control: str = "") -> StoreBook:
        """An empty journal for the next push into a machine's control.

        Raises
        ------
        UnsafeToMove
            The last push is unfinished: finish it first.
        """
        chain = await asyncio.to_thread(store.pushes.chain, machine, control)
        book = await cls.of_chain(store, chain, clock)
        if book is None:
            return cls(store, chain, clock, 1, GENESIS, ())
        last = (await book.entries())[-1]
        if last.state not in TERMINAL or last.state is PushState.OPERATOR:
            raise UnsafeToMove(f"push {last.push} of {chain} is in state {last.state}", "finish this push first")
        return cls(store, chain, clock, last.push + 1, last.digest, ())

    async def entries(self) -> Journal:
        """Return the entries of this push so far, oldest first."""
        return self._journal

    async def append(self, journal: Journal, state: PushState, doc: Doc) -> PushEntry:
        """Write the next entry; on return it is on disk.

        Raises
        ------
        JournalBroken
            This state cannot follow.
        StoreError
            Another process has written an entry meanwhile, or the database refuses it.
        """
        entry = follow(journal, self._push, state, doc, utc=utc_text(self._clock.utc()), head=self._head, machine=self._machine)
        await self._store.write(self._store.pushes.append, entry)
        self._head, self._journal = entry.digest, (*journal, entry)
        return entry


def push_log(journal: Journal) -> tuple[str, ...]:
    """Return every transition of a push as a line for people."""
    lines = []
    for entry in journal:
        known = facts((entry,))
        parts = [known.why, known.pending, known.again, known.approved_by, known.probe, known.verify]
        if entry.state is PushState.SNAPSHOT:
            parts = [f"bank {known.base_bank}, CRC {known.base_crc:08X}; new table: CRC {known.crc:08X}"]
        lines.append(": ".join([str(entry.state), *filter(None, parts)]) + f" ({entry.utc})")
    return tuple(lines)


@dataclass(frozen=True, slots=True)
class Capabilities:
    """Flags of one controller. Each is proved by its own commissioning test; an unproved one is False."""

    two_banks: bool = False
    swap_compares: bool = False
    """The controller refuses an activation when CRC or generation are not the expected ones."""
    generation: bool = False
    boot_id: bool = False
    interlocks: bool = False
    """The controller itself refuses an activation while the machine moves or an interlock is open."""
    lease: bool = False
    can_disable: bool = False
    """With one table only (`abbe.drivers.api.OneBank`), proved by ``abbe comp commission --one-bank``: the control refuses writes while
    the table acts, and a switch with a wrong CRC; it reports that a table is switched off."""

    @property
    def level(self) -> int:
        """Allowed pushes. 3: unattended; 2: attended; 1: attended, one table; 0: none, the controller can only be read."""
        flags = [getattr(self, f.name) for f in fields(self) if f.name != "can_disable"]
        if all(flags):
            return 3
        if self.two_banks and self.generation and self.boot_id:
            return 2
        return 1 if self.can_disable else 0


NEEDS_ATTENDANCE = (
    "this controller is not proved to compare and swap, keep a lease and watch its axes: a person who approves has to be at the machine"
)


def objection(level: int, *, attended: bool) -> str:
    """Return the reason why a push is not allowed at this level; empty if it is allowed."""
    if level >= 3:
        return ""
    if level in (1, 2):
        return "" if attended else NEEDS_ATTENDANCE
    return "this controller can only be read: export the table as a file"
