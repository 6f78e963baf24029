"""Which tables the journals of a database know, and which of them nothing has verified, whatever a machine is called.

A control is known by its address alone (`abbe.service.devices.urls.control_of`), and a table carries a number drawn by lot: so the CRC in
force is held against all journals, and nothing is built on a table that a push brought and that was neither kept nor vouched for. What is
kept or vouched for on one control is so there only: the errors of another machine are others.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from abbe.service.domain.decisions import PushEntryRecord
from abbe.service.domain.document import Doc
from abbe.service.push.entries import JournalEntry
from abbe.service.push.states import BEFORE_ACTIVATION, TERMINAL, PushState
from abbe.service.storage.store import Store

How = Literal["verified", "accepted", "found in force"]
Row = tuple[Hashable, str, Doc]
"""Push, state, and what became known with it."""


@dataclass(frozen=True, slots=True)
class PushedTable:
    """A push as all journals tell it: under which machine's name, into which control (empty: not noted), and where it stands.

    ``chain``: name of its journal.
    """

    chain: str
    push: int
    state: str
    machine: str
    control: str

    @property
    def open(self) -> bool:
        """It has not come to its end, or a person has to look."""
        return self.state not in TERMINAL or self.state == PushState.OPERATOR

    @property
    def may_be_active(self) -> bool:
        """Its table may be in force."""
        return self.open and self.state not in BEFORE_ACTIVATION


@dataclass(frozen=True, slots=True)
class Endorsement:
    """Why a table is right on one control: a push kept it there, a person vouched for it, or the first push found it in force.

    ``push``: 0 for a person's word before the first; ``by``: who vouched, empty for no person.
    """

    how: How
    machine: str
    push: int
    utc: str
    by: str = ""

    @property
    def not_here(self) -> str:
        """The same said of another machine."""
        push = f" (push {self.push})" if self.push and self.how == "verified" else ""
        return f"{self.how} on machine {self.machine!r}{push}, not on this one"


@dataclass(frozen=True, slots=True)
class KnownTables:
    """Tables by their CRC, over all journals of a database.

    ``unverified``: which push brought it; ``known_crcs``: every table that a push brought or found in force, or that a person vouched for;
    ``pushed``: the last push of each; ``endorsed``: in which journals it is right, and why.
    """

    unverified: dict[int, PushedTable]
    known_crcs: frozenset[int]
    pushed: dict[int, PushedTable]
    endorsed: dict[int, dict[str, Endorsement]]

    def elsewhere(self, crc: int, chain: str) -> Endorsement | None:
        """Where a table is right that is not known to be so in this journal; None if it is, or is nowhere."""
        where = self.endorsed.get(crc, {})
        return None if chain in where else max(where.values(), key=lambda one: (one.how == "verified", one.utc), default=None)


def known_tables(store: Store) -> KnownTables:
    """Read the journals of all machines, without the images in them."""
    marks = store.pushes.marks()
    unverified = _unverified([((m.machine, m.push), m.state, m.doc) for m in marks])
    last: dict[Hashable, PushedTable] = {}
    crc: dict[Hashable, int] = {}
    endorsed: dict[int, dict[str, Endorsement]] = {}
    crcs: set[int] = set()
    for mark in marks:
        key, doc = (mark.machine, mark.push), mark.doc
        named = (last[key].machine, last[key].control) if key in last else (doc.get("machine", mark.machine), doc.get("control", ""))
        last[key] = PushedTable(mark.machine, mark.push, mark.state, str(named[0]), str(named[1]))
        crcs.update(int(doc[name]) for name in ("base_crc", "crc", "accepted_crc") if name in doc)
        if mark.state == PushState.SNAPSHOT and "crc" in doc:
            base = int(doc["base_crc"])
            if base in endorsed or base not in crc.values():
                _add(endorsed, base, "found in force", last[key], mark)
            crc[key] = int(doc["crc"])
        elif mark.state == PushState.KEEP and key in crc:
            _add(endorsed, crc[key], "verified", last[key], mark)
        elif "accepted_crc" in doc:
            _add(endorsed, int(doc["accepted_crc"]), "accepted", last[key], mark)
    pushed = {number: last[key] for key, number in crc.items()}
    return KnownTables({number: last[key] for number, key in unverified.items()}, frozenset(crcs), pushed, endorsed)


def _add(endorsed: dict[int, dict[str, Endorsement]], crc: int, how: How, push: PushedTable, mark: PushEntryRecord) -> None:
    """Note why a table is right in a journal; that a later push found it in force says less than what is there."""
    one = Endorsement(how, push.machine, push.push, mark.utc, str(mark.doc.get("by", "")) if how == "accepted" else "")
    where, chain = endorsed.setdefault(crc, {}), push.chain
    if how != "found in force" or chain not in where:
        where[chain] = one


def unverified_crcs(entries: Sequence[JournalEntry]) -> dict[int, int]:
    """Which tables of one journal were neither kept nor vouched for: CRC -> number of the push."""
    found = _unverified([(e.push, e.state, e.doc) for e in entries])
    return {crc: push for crc, push in found.items() if isinstance(push, int)}


def _unverified(rows: Iterable[Row]) -> dict[int, Hashable]:
    """A table that was in force before a push was put there by a person, unless an earlier push had brought it and not kept it."""
    candidates: dict[int, Hashable] = {}
    pushed: dict[Hashable, int] = {}
    endorsed: set[int] = set()
    for push, state, doc in rows:
        if state == PushState.SNAPSHOT and "crc" in doc:
            base, crc = int(doc["base_crc"]), int(doc["crc"])
            if base not in candidates:
                endorsed.add(base)
            pushed[push] = crc
            candidates.setdefault(crc, push)
        elif state == PushState.KEEP and push in pushed:
            endorsed.add(pushed[push])
        elif state == PushState.ACCEPTED and "accepted_crc" in doc:
            endorsed.add(int(doc["accepted_crc"]))
    return {crc: push for crc, push in candidates.items() if crc not in endorsed}
