"""Knowledge about tables from the push journals of a database: which were pushed, kept, accepted, or never verified.

Each table contains a random number, so its CRC identifies it: the CRC is looked up in all journals, under any machine name.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from abbe.service.domain.document import Doc, parsed
from abbe.service.domain.push_entry import BEFORE_ACTIVATION, TERMINAL, PushEntry, PushState
from abbe.service.storage.store import Store

How = Literal["verified", "accepted", "found in force"]
Row = tuple[Hashable, str, Doc]
"""Push, state, and the document of the entry."""


@dataclass(frozen=True, slots=True)
class PushedTable:
    """A push: name of its journal (``chain``), machine name, control (empty: not recorded), and last state."""

    chain: str
    push: int
    state: str
    machine: str
    control: str

    @property
    def open(self) -> bool:
        """Whether the push has not ended or waits for a person."""
        return self.state not in TERMINAL or self.state == PushState.OPERATOR

    @property
    def may_be_active(self) -> bool:
        """Whether the table of the push may be in force."""
        return self.open and self.state not in BEFORE_ACTIVATION


@dataclass(frozen=True, slots=True)
class Endorsement:
    """Reason why a table is valid on one control: a push kept it, a person accepted it, or the first push found it in force.

    ``push``: 0 for an acceptance before the first push; ``by``: who accepted it, empty for no person.
    """

    how: How
    machine: str
    push: int
    utc: str
    by: str = ""

    @property
    def not_here(self) -> str:
        """Return why the table is not accepted on another machine: it was verified or accepted only on the machine of this endorsement."""
        push = f" (push {self.push})" if self.push and self.how == "verified" else ""
        return f"{self.how} on machine {self.machine!r}{push}, not on this one"


@dataclass(frozen=True, slots=True)
class KnownTables:
    """Tables by their CRC, over all journals of a database.

    ``unverified``: tables that were neither kept nor accepted, with the push that wrote each; ``known_crcs``: every table that a push wrote
    or found in force, or that a person accepted; ``pushed``: the last push of each table; ``endorsed``: its endorsements by journal.
    """

    unverified: dict[int, PushedTable]
    known_crcs: frozenset[int]
    pushed: dict[int, PushedTable]
    endorsed: dict[int, dict[str, Endorsement]]

    def elsewhere(self, crc: int, chain: str) -> Endorsement | None:
        """Best endorsement of a table in other journals; None if the journal ``chain`` endorses it, or no journal does."""
        journals = self.endorsed.get(crc, {})
        return None if chain in journals else max(journals.values(), key=lambda one: (one.how == "verified", one.utc), default=None)


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
        known = parsed(_Crcs, doc)
        crcs.update(one for one in (known.base_crc, known.crc, known.accepted_crc) if one is not None)
        if mark.state == PushState.SNAPSHOT and known.begun is not None:
            base, written = known.begun
            if base in endorsed or base not in crc.values():
                _add(endorsed, base, "found in force", last[key], mark)
            crc[key] = written
        elif mark.state == PushState.KEEP and key in crc:
            _add(endorsed, crc[key], "verified", last[key], mark)
        elif known.accepted_crc is not None:
            _add(endorsed, known.accepted_crc, "accepted", last[key], mark)
    pushed = {number: last[key] for key, number in crc.items()}
    return KnownTables({number: last[key] for number, key in unverified.items()}, frozenset(crcs), pushed, endorsed)


def _add(endorsed: dict[int, dict[str, Endorsement]], crc: int, how: How, push: PushedTable, mark: PushEntry) -> None:
    """Add an endorsement to a journal; "found in force" never replaces an earlier one."""
    one = Endorsement(how, push.machine, push.push, mark.utc, str(mark.doc.get("by", "")) if how == "accepted" else "")
    journals, chain = endorsed.setdefault(crc, {}), push.chain
    if how != "found in force" or chain not in journals:
        journals[chain] = one


def unverified_crcs(entries: Sequence[PushEntry]) -> dict[int, int]:
    """Tables of one journal that were neither kept nor accepted: CRC -> number of the push."""
    found = _unverified([(e.push, e.state, e.doc) for e in entries])
    return {crc: push for crc, push in found.items() if isinstance(push, int)}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Crcs:
    """The tables that an entry of the push journal names: found in force, written, accepted by a person."""

    base_crc: int | None = None
    crc: int | None = None
    accepted_crc: int | None = None

    @property
    def begun(self) -> tuple[int, int] | None:
        """CRCs in the first entry of a push: of the table found in force and of the table to be written; None if it names no table."""
        if self.crc is None:
            return None
        if self.base_crc is None:
            raise KeyError("base_crc")
        return self.base_crc, self.crc


def _unverified(rows: Iterable[Row]) -> dict[int, Hashable]:
    """Unverified tables. A table found in force counts as endorsed, unless an earlier push wrote it and did not keep it."""
    candidates: dict[int, Hashable] = {}
    pushed: dict[Hashable, int] = {}
    endorsed: set[int] = set()
    for push, state, doc in rows:
        known = parsed(_Crcs, doc)
        if state == PushState.SNAPSHOT and known.begun is not None:
            base, crc = known.begun
            if base not in candidates:
                endorsed.add(base)
            pushed[push] = crc
            candidates.setdefault(crc, push)
        elif state == PushState.KEEP and push in pushed:
            endorsed.add(pushed[push])
        elif state == PushState.ACCEPTED and known.accepted_crc is not None:
            endorsed.add(known.accepted_crc)
    return {crc: push for crc, push in candidates.items() if crc not in endorsed}
