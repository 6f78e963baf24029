"""Entries of the push journal: one for every transition, each chained to the one before it by SHA-256 over canonical JSON.

The journal is also the audit trail: an entry that is changed, removed or swapped breaks the chain.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

from abbe.service.push.order import OperationOrder
from abbe.service.push.states import FOLLOWS, PushState

Doc = dict[str, Any]
GENESIS = "0" * 64
WORD = 0
"""Number under which a person's word about a table stands in a journal that has no push yet."""


class JournalBroken(ValueError):  # noqa: N818 - reads as what it is
    """An entry does not follow from the one before it: the chain, the order or the transition is wrong."""


@dataclass(frozen=True, slots=True)
class JournalEntry:
    """One transition of one push. Never changed after writing.

    Parameters
    ----------
    push : int
        Number of the push.
    seq : int
        Number of the entry in its push, from 0.
    state : PushState
        State that was reached.
    doc : dict
        What became known with it.
    utc : str
        When, for people.
    prev, digest : str
        SHA-256 of the entry before it (of any push of the machine), and of this one.
    """

    push: int
    seq: int
    state: PushState
    doc: Doc
    utc: str
    prev: str
    digest: str


Journal = tuple[JournalEntry, ...]


def canonical(value: object) -> bytes:
    """Write a JSON value in the one way in which it is hashed: keys sorted, no blanks, no NaN."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=False).encode()


def digest_of(push: int, seq: int, state: PushState, doc: Doc, utc: str, prev: str) -> str:
    """SHA-256 of an entry's content and of the digest before it."""
    return hashlib.sha256(canonical([push, seq, str(state), doc, utc, prev])).hexdigest()


def follow(journal: Journal, push: int, state: PushState, doc: Doc, utc: str, head: str) -> JournalEntry:
    """Make the next entry of a push.

    Parameters
    ----------
    journal : tuple of JournalEntry
        The push so far; empty for its first entry.
    push : int
        Its number.
    state : PushState
        State that was reached.
    doc : dict
        What became known with it.
    utc : str
        When.
    head : str
        Digest of the last entry of the machine, `GENESIS` if there is none.

    Raises
    ------
    JournalBroken
        This state cannot follow.
    """
    last = journal[-1].state if journal else None
    if not _may_follow(push, last, state):
        raise JournalBroken(f"push {push}: {state} cannot follow {last or 'nothing'}")
    return JournalEntry(push, len(journal), state, doc, utc, head, digest_of(push, len(journal), state, doc, utc, head))


def _may_follow(push: int, last: PushState | None, state: PushState) -> bool:
    return state in FOLLOWS[last] or (push == WORD and last is None and state is PushState.ACCEPTED)


def check_chain(entries: Sequence[JournalEntry], head: str = GENESIS) -> None:
    """Check all entries of a machine, in the order of writing.

    Raises
    ------
    JournalBroken
        Which entry does not follow, or was changed.
    """
    last: dict[int, JournalEntry] = {}
    for entry in entries:
        before = last.get(entry.push)
        name = f"push {entry.push}, entry {entry.seq}"
        if entry.prev != head:
            raise JournalBroken(f"{name}: does not follow the entry before it")
        if entry.digest != digest_of(entry.push, entry.seq, entry.state, entry.doc, entry.utc, entry.prev):
            raise JournalBroken(f"{name}: was changed after it was written")
        if entry.seq != (before.seq + 1 if before else 0) or not _may_follow(entry.push, before.state if before else None, entry.state):
            raise JournalBroken(f"{name}: {entry.state} cannot stand here")
        last[entry.push], head = entry, entry.digest


NOT_YET = -1
"""A figure that no entry of a push has given yet: no controller states it, so nothing is ever equal to it."""


@dataclass(frozen=True, slots=True)
class ControllerSays:
    """What a controller said of its banks when a person was called: the active one, and the CRC of each."""

    active: int = NOT_YET
    crc: tuple[int, ...] = ()

    @property
    def in_force(self) -> int:
        """CRC of the active bank; `NOT_YET` where nothing was noted."""
        return self.crc[self.active] if self.crc else NOT_YET


@dataclass(frozen=True, slots=True, kw_only=True)
class PushFacts(OperationOrder):
    """Everything that a push's journal says, later entries over earlier ones, by the state whose entry brings it.

    SNAPSHOT: the order, and what was read: boot id, generation and register map of the
    controller, bank, CRC, bytes and meaning of the table in force, and the bank ``target`` to which the new one goes. REJECTED: reasons.
    APPROVED: digest, who, until when. STAGED, ACTIVATING, PROBATION: generations, and the CRC that the activation expects. PROBED and
    VERIFIED: what was found. RESTAGING and ACTIVATING_BACK: bank, generation and boot id for the way back. ROLLBACK_PENDING: what it waits
    for. OPERATOR: why, and what the controller said. ACCEPTED: for which table a person vouches.
    """

    boot: int = NOT_YET
    gen: int = NOT_YET
    map: str = ""
    base_bank: int = NOT_YET
    base_crc: int = NOT_YET
    base_image: bytes = b""
    base_meaning: str = ""
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
    controller: ControllerSays = field(default_factory=ControllerSays)
    accepted_bank: int = NOT_YET
    accepted_crc: int = NOT_YET
    by: str = ""

    def binding(self, expiry: str) -> str:
        """What an approval until ``expiry`` has to bind (`approval_digest`)."""
        return approval_digest(self.image, base_image=self.base_image, machine=self.machine, limits=self.limits, expiry=expiry)


def _bytes(text: str) -> bytes:
    """Bytes of a hexadecimal text; none where somebody changed it into another."""
    try:
        return bytes.fromhex(text)
    except ValueError:
        return b""


_CONVERTED: dict[str, Callable[[Any], Any]] = {
    "image": _bytes,
    "base_image": _bytes,
    "reasons": tuple,
    "controller": lambda doc: ControllerSays(doc["active"], tuple(doc["crc"])),
}
_NO_ORDER: Doc = {
    "machine": "",
    "image": b"",
    "crc": NOT_YET,
    "meaning": "",
    "limits": "",
    "owner": NOT_YET,
    "level": NOT_YET,
    "chunk_words": 0,
}
_FIELDS = tuple((one.name, _CONVERTED.get(one.name)) for one in fields(PushFacts))
_SNAPSHOT = frozenset({
    "machine", "image", "crc", "meaning", "limits", "owner", "level", "attended", "chunk_words", "boot", "gen", "map",
    "base_bank", "base_crc", "base_image", "base_meaning", "target",
})  # fmt: skip


def facts(journal: Journal) -> PushFacts:
    """Everything that a push's journal says, later entries over earlier ones."""
    return _parsed(_merged(journal))


def facts_to_act_on(journal: Journal) -> PushFacts:
    """The same, complete enough to act on a controller.

    Raises
    ------
    JournalBroken
        The SNAPSHOT does not say all that the way back needs.
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
    said = {name: doc[name] if convert is None else convert(doc[name]) for name, convert in _FIELDS if name in doc}
    return PushFacts(**(_NO_ORDER | said))


def approval_digest(image: bytes, *, base_image: bytes, machine: str, limits: str, expiry: str) -> str:
    """SHA-256 that a person agrees to: exactly this table, on exactly this base, for this machine, under these limits, until then.

    Parameters
    ----------
    image, base_image : bytes
        The new table and the one in force.
    machine : str
        Name of the machine.
    limits : str
        Digest of the limits (`abbe.service.push.limits.PushLimits.digest`).
    expiry : str
        When the approval ends.
    """
    return hashlib.sha256(canonical([image.hex(), base_image.hex(), machine, limits, expiry])).hexdigest()
