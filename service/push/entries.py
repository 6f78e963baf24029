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
NO_PUSH = 0
"""Push number of a person's acceptance in a journal that has no push yet."""


class JournalBroken(ValueError):  # noqa: N818 - reads as what it is
    """An entry does not follow from the one before it: chain, order or transition are wrong."""


@dataclass(frozen=True, slots=True)
class JournalEntry:
    """One transition of one push. Never changed after writing.

    ``seq``: number of the entry in its push, from 0; ``doc``: what became known with the state; ``utc``: for people; ``prev``, ``digest``:
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
    """Canonical JSON for hashing: sorted keys, no blanks. Raises ValueError for NaN and Inf."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=False).encode()


def digest_of(push: int, seq: int, state: PushState, doc: Doc, utc: str, prev: str) -> str:
    """SHA-256 of an entry's content and of the digest before it."""
    return hashlib.sha256(canonical([push, seq, str(state), doc, utc, prev])).hexdigest()


def follow(journal: Journal, push: int, state: PushState, doc: Doc, utc: str, head: str) -> JournalEntry:
    """Make the next entry of a push. ``head``: digest of the last entry of the machine, `GENESIS` if there is none.

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
    return state in FOLLOWS[last] or (push == NO_PUSH and last is None and state is PushState.ACCEPTED)


def check_chain(entries: Sequence[JournalEntry], head: str = GENESIS) -> None:
    """Check all entries of a machine, in the order of writing.

    Raises
    ------
    JournalBroken
        Names the entry that does not follow, or was changed.
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
"""A number that no entry has stated yet: no controller reports it, so no comparison with it succeeds."""


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
    """Everything that a push's journal states; later entries override earlier ones. By the state whose entry brings it:

    SNAPSHOT: the order; boot id, generation and register map of the controller; bank, CRC, bytes and semantic digest of the table in
    force; the bank ``target`` for the new table. REJECTED: reasons. APPROVED: digest, approver, expiry. STAGED, ACTIVATING, PROBATION:
    generations, and the CRC that the activation expects. PROBED, VERIFIED: the findings. RESTAGING, ACTIVATING_BACK: bank, generation and
    boot id of the rollback. ROLLBACK_PENDING: what blocks it. OPERATOR: the reason, and the controller's report. ACCEPTED: the table that a
    person vouches for.
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
    controller: ReportedBanks = field(default_factory=ReportedBanks)
    accepted_bank: int = NOT_YET
    accepted_crc: int = NOT_YET
    by: str = ""

    def binding(self, expiry: str) -> str:
        """What an approval until ``expiry`` has to bind (`approval_digest`)."""
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
    known = {name: doc[name] if convert is None else convert(doc[name]) for name, convert in _FIELDS if name in doc}
    return PushFacts(**(_NO_ORDER | known))


def approval_digest(image: bytes, *, base_image: bytes, machine: str, limits: str, expiry: str) -> str:
    """SHA-256 that an approval binds: exactly this table on exactly this base, for this machine, under these limits, until ``expiry``.

    ``limits``: their digest (`abbe.service.push.limits.PushLimits.digest`).
    """
    return hashlib.sha256(canonical([image.hex(), base_image.hex(), machine, limits, expiry])).hexdigest()
