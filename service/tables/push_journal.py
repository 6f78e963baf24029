"""Evaluate the push journal of one machine: how each push ended, which table is in force, what can be rolled back.

Nothing here talks to a controller. `JournalView.read` reads the database once; its properties need no further reads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from functools import cached_property
from typing import Any, Literal

from abbe.service.domain.progress import JobOutcome
from abbe.service.domain.push_entry import BEFORE_ACTIVATION, TERMINAL, PushEntry, PushState
from abbe.service.errors import JournalChanged, TableMismatch, TableRefused
from abbe.service.push.journal import NO_PUSH, NOT_YET, Journal, JournalBroken, PushFacts, check_chain, facts
from abbe.service.storage.store import Store
from abbe.service.tables.known_tables import PushedTable, known_tables

KIND = "rollback"
"""Kind of a table that a person restored by an ordered rollback."""
STILL_ACTIVE = "the unverified table is STILL ACTIVE"
OPEN, STOPPED = "open", "stopped"
NOTHING = "nothing was written"


@dataclass(frozen=True, slots=True)
class TableOrigin:
    """Reason for the push of a stored table: a proposal (``proposal``; 0: none), or a person's order (``order``: its number,
    ``reason``)."""

    kind: str = "push"
    proposal: int = 0
    order: str = ""
    reason: str = ""

    @classmethod
    def of(cls, doc: Mapping[str, Any]) -> TableOrigin:
        """Read the origin from the document of a stored table."""
        proposal = doc.get("proposal")
        number = proposal if isinstance(proposal, int) else 0
        return cls(str(doc.get("kind", "push")), number, str(doc.get("order", "")), str(doc.get("reason", "")))


@dataclass(frozen=True, slots=True)
class TableNames:
    """Names of the two tables in messages about a push: the new one in full and in short, and the old one."""

    new: str = "the new table"
    it: str = "the new one"
    old: str = "the old table"


BACK = TableNames("the table ordered back", "the one ordered back", "the table from before the order")


@dataclass(frozen=True, slots=True)
class PushSummary:
    """One push. ``proposal``: 0 for none; ``word``, ``text``: its outcome as in `JobOutcome`; ``by``: who approved or ordered it.

    ``why``: a person's reason for a rollback.
    """

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
    """The table in force according to the journal.

    ``crc``: None if unknown, for the reason in ``text``. ``how``: "verified" by a measurement; "ordered": restored by a person, without a
    measurement; "accepted" by a person; "before": in force before the first push. ``push``: the push that wrote it, 0 for none.
    """

    crc: int | None
    how: Literal["", "verified", "ordered", "accepted", "before"]
    push: int
    utc: str
    text: str


@dataclass(frozen=True, slots=True)
class RollbackOffer:
    """A possible rollback: ``to_crc`` replaces the table of ``push`` (CRC ``crc``)."""

    push: int
    crc: int
    to_crc: int


@dataclass(frozen=True, slots=True)
class TableHistory:
    """History of a machine's tables. ``offer``: None if no rollback is possible, for the reason in ``refusal``."""

    now: CurrentTable
    pushes: tuple[PushSummary, ...]
    offer: RollbackOffer | None
    refusal: str


@dataclass(frozen=True)
class JournalView:
    """All journal entries of a machine's pushes, in the order of writing, and the origins of the stored tables by number.

    `pushes`, and everything that uses it, raises `JournalChanged` if an entry was changed, removed or swapped.
    """

    entries: tuple[PushEntry, ...] = ()
    origins: Mapping[int, TableOrigin] = field(default_factory=dict)

    @classmethod
    def read(cls, store: Store, machine: str, control: str = "", *, origins: bool = True) -> JournalView:
        """Read the journal of a machine's control under any name the machine had.

        Parameters
        ----------
        control : str
            Identity of the control; empty: find the journal by the name alone.
        origins : bool
            Also read the origins of the tables. Without them no push belongs to a proposal or an order.

        Raises
        ------
        StoreError
            The database cannot be read.
        """
        return cls(tuple(store.pushes.entries(machine, control)), origins_of(store) if origins else {})

    @property
    def sound(self) -> bool:
        """Whether the hash chain of the journal is intact."""
        try:
            check_chain(self.entries)
        except JournalBroken:
            return False
        return True

    @cached_property
    def pushes(self) -> dict[int, Journal]:
        """Journals of all pushes, by number, without an acceptance before the first push."""
        try:
            check_chain(self.entries)
        except JournalBroken as error:
            raise JournalChanged(
                f"the push journal was changed after it was written: {error}", "restore the database from a backup"
            ) from None
        numbers = sorted({e.push for e in self.entries} - {NO_PUSH})
        return {n: self._of(n) for n in numbers}

    def _of(self, push: int) -> Journal:
        return tuple(e for e in self.entries if e.push == push)

    def facts(self, push: int) -> PushFacts:
        """Facts recorded about a push."""
        return facts(self._of(push))

    def origin(self, journal: Journal) -> TableOrigin:
        """The reason why the table of a push was pushed."""
        return self.origins.get(facts(journal).table, TableOrigin())

    @property
    def last_push(self) -> int:
        """Number of the last push; 0 for none."""
        return max((entry.push for entry in self.entries), default=0)

    @property
    def wanted(self) -> tuple[int | None, bool]:
        """The CRC that should be in force, and whether the last push has ended. CRC None: no push yet, or the last has not ended.

        A push that changed nothing does not confirm the table that it found in force.
        """
        if not self.entries:
            return None, True
        last = self.entries[-1]
        if last.state not in TERMINAL or last.state is PushState.OPERATOR:
            return None, False
        for entry in reversed(self.entries):
            if entry.state is PushState.ACCEPTED:
                return facts((entry,)).accepted_crc, True
            if entry.state is PushState.KEEP:
                return self.facts(entry.push).crc, True
        bases = (facts((entry,)).base_crc for entry in self.entries if entry.state is PushState.SNAPSHOT)
        return next((crc for crc in bases if crc != NOT_YET), None), True

    @property
    def changes(self) -> list[PushEntry]:
        """Entries that put a table into force permanently: kept, or accepted by a person. Pushes that were rolled back are left out."""
        return [e for e in self.entries if e.state in (PushState.KEEP, PushState.ACCEPTED)]

    def kept(self, before: datetime | None = None) -> list[PushFacts]:
        """Kept pushes, oldest first, up to the time ``before``."""
        keeps = [e for e in self.entries if e.state is PushState.KEEP]
        return [self.facts(e.push) for e in keeps if before is None or datetime.fromisoformat(e.utc) <= before]

    @property
    def last_kept_s(self) -> float:
        """Time of the last kept push, seconds since the epoch; minus infinity for never."""
        keeps = [e.utc for e in self.entries if e.state is PushState.KEEP]
        return datetime.fromisoformat(keeps[-1]).timestamp() if keeps else float("-inf")

    def bases(self) -> Iterator[PushFacts]:
        """Facts about the table that each push found in force."""
        return (facts((e,)) for e in self.entries if e.state is PushState.SNAPSHOT)

    def of_proposal(self, proposal: int, after: int = 0) -> JobOutcome | None:
        """Outcome of the proposal's last push with a number above ``after``; None: there is none, so nothing was written."""
        return self._last_own(lambda number, origin: number > after and origin.proposal == proposal, TableNames())

    def of_order(self, order: str) -> JobOutcome | None:
        """Outcome of an ordered rollback; None if the journal does not contain it: nothing was written."""
        return self._last_own(lambda _, origin: origin.order == order, BACK)

    def _last_own(self, own: Callable[[int, TableOrigin], bool], names: TableNames) -> JobOutcome | None:
        mine = [journal for number, journal in self.pushes.items() if own(number, self.origin(journal))]
        return outcome_of(mine[-1], names) if mine else None

    @property
    def open_push(self) -> str:
        """The open state of the last push as a sentence; empty if it has ended."""
        found = outcome_of(self.pushes[max(self.pushes)]) if self.pushes else None
        return found.text if found is not None and found.word == OPEN else ""

    def last_kept(self) -> Journal:
        """The last kept push, if it can be rolled back.

        Raises
        ------
        TableRefused
            No push was kept, or the last kept push was a rollback.
        """
        kept = [j for j in self.pushes.values() if ended_as(j) is PushState.KEEP]
        if not kept:
            raise TableRefused("no push of this machine was kept: there is nothing to roll back", NOTHING)
        if self.origin(kept[-1]).kind == KIND:
            raise TableRefused(
                f"the last kept push ({kept[-1][-1].push}) was itself a rollback",
                f"choose the push whose table is wanted again: abbe comp rollback -m MACHINE.toml --to PUSH; {NOTHING}",
            )
        return kept[-1]

    def offer(self) -> RollbackOffer:
        """The rollback that is possible now.

        Raises
        ------
        TableRefused
            No rollback is possible; the message gives the reason.
        """
        if not self.entries:
            raise TableRefused("no push of this machine is in the journal: there is nothing to roll back", NOTHING)
        crc, settled = self.wanted
        if crc is None or not settled:
            text = outcome_of(self._of(self.entries[-1].push)).text
            raise TableRefused(f"the table in force is not known: {text}", NOTHING)
        last = self.last_kept()
        known = facts(last)
        if known.crc != crc:
            raise TableRefused(
                f"the table in force ({crc:08X}) is not the one of push {last[-1].push}, the last that was kept",
                f"choose the push whose table is wanted again: abbe comp rollback -m MACHINE.toml --to PUSH; {NOTHING}",
            )
        return RollbackOffer(last[-1].push, crc, known.base_crc)

    def history(self) -> TableHistory:
        """History of the machine's tables, newest push first."""
        summaries = tuple(self._summary(journal) for journal in self.pushes.values())
        try:
            offer, refusal = self.offer(), ""
        except TableRefused as error:
            offer, refusal = None, error.detail
        return TableHistory(self._now(summaries), tuple(reversed(summaries)), offer, refusal)

    def _summary(self, journal: Journal) -> PushSummary:
        last, known, origin = journal[-1], facts(journal), self.origin(journal)
        outcome = outcome_of(journal, BACK if origin.kind == KIND else TableNames())
        # The table that was in force at the end of a push need not be in force now: an ended push shows only its cause.
        ended = {PushState.KEEP: known.verify, PushState.ROLLED_BACK: known.why, PushState.ABORTED: known.why}
        return PushSummary(
            last.push, origin.kind, origin.proposal, known.crc, known.base_crc, journal[0].utc, last.utc, str(last.state),
            outcome.word, ended.get(last.state, outcome.text), known.approved_by, origin.reason,
        )  # fmt: skip

    def _now(self, summaries: tuple[PushSummary, ...]) -> CurrentTable:
        crc, settled = self.wanted
        if not self.entries:
            return CurrentTable(None, "", 0, "", "no push of this machine is in the journal")
        if crc is None or not settled:
            return CurrentTable(None, "", summaries[-1].push, summaries[-1].ended, summaries[-1].text)
        for entry in reversed(self.entries):
            if entry.push == NO_PUSH:
                return CurrentTable(crc, "accepted", 0, entry.utc, "a person vouches for the table that was there before the first push")
            one = next(t for t in summaries if t.push == entry.push)
            if entry.state is PushState.ACCEPTED and facts((entry,)).accepted_crc == crc:
                return CurrentTable(crc, "accepted", one.push, entry.utc, one.text)
            if entry.state is PushState.KEEP and one.crc == crc:
                return CurrentTable(crc, "ordered" if one.kind == KIND else "verified", one.push, entry.utc, one.text)
        return CurrentTable(crc, "before", 0, "", "this table was there before the first push")


def origins_of(store: Store) -> dict[int, TableOrigin]:
    """Origin of each stored table, by number."""
    return {table.id: TableOrigin.of(table.doc) for table in store.tables.all()}


def open_pushes(store: Store, machine: str, control: str = "") -> list[str]:
    """Describe the open pushes: the machine's own last one, and pushes of other journals whose unverified table may be in force.

    Another journal may belong to the same control under another name or address.
    """
    chain, own = store.pushes.chain(machine, control), JournalView.read(store, machine, control).open_push
    others = [p for p in known_tables(store).unverified.values() if p.may_be_active and p.chain != chain]
    return [*filter(None, [own]), *map(_other, others)]


def _other(push: PushedTable) -> str:
    at = f" at {push.control}" if push.control else ""
    what = "its table was never verified; if that push went into this control, Abbe refuses to measure here"
    return f"push {push.push} of machine {push.machine!r}{at} is in state {push.state}: {what}"


def ended_as(journal: Journal) -> PushState:
    """Current or final state of a push, ignoring a later acceptance by a person."""
    return next((e.state for e in reversed(journal) if e.state is not PushState.ACCEPTED), PushState.ACCEPTED)


def outcome_of(journal: Journal, names: TableNames = TableNames()) -> JobOutcome:
    """Outcome of a push from its journal."""
    last, known = journal[-1], facts(journal)
    name, why = f"push {last.push}", known.why
    match last.state:
        case PushState.KEEP:
            return JobOutcome("kept", f"{name}: {names.new} is kept and in force: {known.verify}")
        case PushState.ROLLED_BACK:
            return JobOutcome("rolled back", f"{name}: {names.old} is in force again: {why}")
        case PushState.REJECTED:
            return JobOutcome("refused", f"{name}: nothing was written: {'; '.join(known.reasons) or why}")
        case PushState.ABORTED:
            return JobOutcome("failed", f"{name}: {names.old} is in force, {names.it} never came into force: {why}")
        case PushState.ACCEPTED:
            new = known.accepted_crc == known.crc
            return JobOutcome("kept" if new else "rolled back", f"{name}: a person vouches for {names.new if new else 'another table'}")
        case PushState.OPERATOR:
            return JobOutcome(OPEN, f"{operator_needed(journal)}; a person has to look")
        case state if state in BEFORE_ACTIVATION:
            return JobOutcome(
                OPEN, f"{name} is in state {state}: {names.old} is in force; the next command that uses the machine finishes the push"
            )
    pending = f" ({known.pending})" if known.pending else ""
    return JobOutcome(
        OPEN, f"{name} is in state {last.state}{pending}: an unverified table may be in force; it is rolled back before anything else"
    )


def reconciled(found: JobOutcome | None, reported: JobOutcome) -> JobOutcome:
    """Correct a push's reported outcome by the journal's outcome ``found`` (None: no entry): the journal decides what is in force."""
    if found is None:
        return reported if reported.word in ("refused", STOPPED) else JobOutcome("failed", reported.text)
    if found.word == reported.word:
        return reported
    word = STOPPED if (found.word, reported.word) == ("failed", STOPPED) else found.word
    return JobOutcome(word, f"{found.text}; {reported.text}")


def operator_needed(journal: Journal, detail: str = "") -> TableMismatch:
    """Error for a push that needs a person: the cause, and whether the unverified table is in force."""
    known = facts(journal)
    cause = f"{detail}; {known.why}" if detail and detail != known.why else known.why
    if known.controller.in_force == known.crc != NOT_YET:
        return TableMismatch(
            f"push {journal[-1].push}: {cause}: {STILL_ACTIVE} (CRC {known.crc:08X})",
            "do not machine; restore the old table at the controller, or vouch for this one with `abbe accept-table -m MACHINE.toml`",
        )
    return TableMismatch(
        f"push {journal[-1].push}: {cause}",
        "look at the controller; if its table is right, say so with `abbe accept-table -m MACHINE.toml`",
    )
