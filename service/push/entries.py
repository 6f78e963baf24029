"""Entries of the push journal: one for every transition, each chained to the one before it by SHA-256 over canonical JSON.

The journal is at the same time the audit trail: whoever changes, removes or swaps an entry breaks the chain.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

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


def facts(journal: Journal) -> Doc:
    """Everything that a push's journal says, later entries over earlier ones."""
    known: Doc = {}
    for entry in journal:
        known.update(entry.doc)
    return known
