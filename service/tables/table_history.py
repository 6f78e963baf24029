"""Which table is in force by the push journal, how it came there, and what a person may order back: for whoever reads, and has no way to
a control. What a controller holds is not asked here; the core looks at it before it writes anything.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from abbe.service.errors import TableRefused
from abbe.service.push.book import read_entries
from abbe.service.push.entries import WORD, Journal, JournalEntry, facts
from abbe.service.push.states import PushState
from abbe.service.storage.store import Store
from abbe.service.tables.push_history import KIND, last_kept, pushes_of, wanted_by
from abbe.service.tables.push_outcome import BACK, Names, outcome_of

Doc = dict[str, Any]


@dataclass(frozen=True, slots=True)
class PushSummary:
    """One push. ``proposal``: 0 for none; ``why``: the reason that a person gave for a rollback; ``by``: who approved or ordered it."""

    push: int
    kind: str
    proposal: int
    crc: int
    base_crc: int
    begun: str
    ended: str
    state: str
    word: str
    text: str
    by: str
    why: str


@dataclass(frozen=True, slots=True)
class CurrentTable:
    """The table in force by the journal.

    ``crc``: None where nobody knows, ``text`` says why. ``how``: "verified" by a measurement, "ordered" back by a person without one,
    "accepted" by a person who looked, "before": it was there before the first push. ``push``: which brought it, 0 for none.
    """

    crc: int | None
    how: Literal["", "verified", "ordered", "accepted", "before"]
    push: int
    utc: str
    text: str


@dataclass(frozen=True, slots=True)
class RollbackOffer:
    """What can be ordered back: the table of ``push`` (CRC ``crc``) goes, the one with ``to_crc`` comes."""

    push: int
    crc: int
    to_crc: int


@dataclass(frozen=True, slots=True)
class TableHistory:
    """Everything of a machine's tables. ``offer``: None where nothing can be taken back, ``refusal`` says why."""

    now: CurrentTable
    pushes: tuple[PushSummary, ...]
    offer: RollbackOffer | None
    refusal: str


def table_history(store: Store, machine: str, control: str = "") -> TableHistory:
    """Read the journal of a machine, newest push first; ``control``: identity of its control, empty where it is not known.

    Raises
    ------
    StoreError
        It cannot be read, or is not what was written.
    """
    entries = read_entries(store, machine, control)
    docs = {table.id: table.doc for table in store.tables.all()}
    told = tuple(_told(journal, _doc(journal, docs)) for journal in pushes_of(entries).values())
    try:
        offer, refusal = offer_of(entries, _rollbacks(docs)), ""
    except TableRefused as no:
        offer, refusal = None, no.detail
    return TableHistory(_now(entries, told), tuple(reversed(told)), offer, refusal)


def offered(store: Store, machine: str, control: str = "") -> RollbackOffer:
    """What can be ordered back now, by the journal (`table_history`).

    Raises
    ------
    TableRefused
        Nothing, and why.
    StoreError
        The journal cannot be read, or is not what was written.
    """
    return offer_of(read_entries(store, machine, control), _rollbacks({table.id: table.doc for table in store.tables.all()}))


def offer_of(entries: list[JournalEntry], rollbacks: frozenset[int]) -> RollbackOffer:
    """The same of entries that were read. ``rollbacks``: numbers of tables that were ordered back."""
    if not entries:
        raise TableRefused("no push of this machine is in the journal: there is nothing to take back", "nothing was written")
    crc, settled = wanted_by(entries)
    if crc is None or not settled:
        journal = tuple(e for e in entries if e.push == entries[-1].push)
        raise TableRefused(f"which table is in force is not known: {outcome_of(journal).text}", "nothing was written")
    last = last_kept(entries, rollbacks)
    known = facts(last)
    if int(known["crc"]) != crc:
        raise TableRefused(
            f"the table in force ({crc:08X}) is not the one of push {last[-1].push}, the last that was kept",
            "say which with abbe comp rollback MACHINE.toml --to PUSH; nothing was written",
        )
    return RollbackOffer(last[-1].push, crc, int(known["base_crc"]))


def _rollbacks(docs: Mapping[int, Doc]) -> frozenset[int]:
    return frozenset(number for number, doc in docs.items() if doc.get("kind") == KIND)


def _doc(journal: Journal, docs: Mapping[int, Doc]) -> Doc:
    return docs.get(int(facts(journal).get("table", 0)), {})


def _told(journal: Journal, doc: Doc) -> PushSummary:
    last, known = journal[-1], facts(journal)
    kind = str(doc.get("kind", "push"))
    outcome = outcome_of(journal, BACK if kind == KIND else Names())
    # What was in force when it ended need not be now: of a push that has ended only the cause is told.
    ended = {PushState.KEEP: "verify", PushState.ROLLED_BACK: "why", PushState.ABORTED: "why"}.get(last.state)
    text = outcome.text if ended is None else str(known.get(ended, ""))
    proposal = doc.get("proposal")
    by, reason = str(known.get("approved_by", "")), str(doc.get("reason", ""))
    return PushSummary(
        last.push, kind, proposal if isinstance(proposal, int) else 0, int(known.get("crc", 0)), int(known.get("base_crc", 0)),
        journal[0].utc, last.utc, str(last.state), outcome.word, text, by, reason,
    )  # fmt: skip


def _now(entries: list[JournalEntry], told: tuple[PushSummary, ...]) -> CurrentTable:
    crc, settled = wanted_by(entries)
    if not entries:
        return CurrentTable(None, "", 0, "", "no push of this machine is in the journal")
    if crc is None or not settled:
        return CurrentTable(None, "", told[-1].push, told[-1].ended, told[-1].text)
    for entry in reversed(entries):
        if entry.push == WORD:
            return CurrentTable(crc, "accepted", 0, entry.utc, "a person vouches for the table that was there before the first push")
        one = next(t for t in told if t.push == entry.push)
        if entry.state is PushState.ACCEPTED and int(entry.doc["accepted_crc"]) == crc:
            return CurrentTable(crc, "accepted", one.push, entry.utc, one.text)
        if entry.state is PushState.KEEP and one.crc == crc:
            return CurrentTable(crc, "ordered" if one.kind == KIND else "verified", one.push, entry.utc, one.text)
    return CurrentTable(crc, "before", 0, "", "it was there before the first push")
