"""How a push that nobody attended ended: by the push journal, which says what is in force, and not by the error that somebody heard."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from abbe.service.domain.job_state import JobOutcome
from abbe.service.push.book import read_entries
from abbe.service.push.entries import Journal, facts
from abbe.service.push.states import BEFORE_ACTIVATION, PushState
from abbe.service.storage.store import Store
from abbe.service.tables.push_history import operator_needed, pushes_of
from abbe.service.tables.unverified import PushedTable, known_tables

OPEN, STOPPED = "open", "stopped"


@dataclass(frozen=True, slots=True)
class Names:
    """What the two tables of a push are called in its sentence: the one that comes, the same again in short, and the one that goes."""

    new: str = "the new table"
    it: str = "the new one"
    old: str = "the old table"


BACK = Names("the table ordered back", "the one ordered back", "the table from before the order")


def last_push(store: Store, machine: str) -> int:
    """Number of the last push of a machine; 0: there was none."""
    return max((entry.push for entry in read_entries(store, machine)), default=0)


def in_force(store: Store, machine: str, proposal: int, after: int) -> JobOutcome | None:
    """How the last push of a proposal stands, of those later than push ``after``; None: the journal has none, nothing was written.

    Raises
    ------
    StoreError
        The journal cannot be read, or is not what was written.
    """
    return _last_own(store, machine, lambda number, doc: number > after and doc.get("proposal") == proposal, Names())


def ordered(store: Store, machine: str, order: str) -> JobOutcome | None:
    """How the push of an ordered rollback stands; None: the journal has none, nothing was written. Raises as `in_force` does."""
    return _last_own(store, machine, lambda _, doc: doc.get("order") == order, BACK)


def _last_own(store: Store, machine: str, own: Callable[[int, dict[str, Any]], bool], names: Names) -> JobOutcome | None:
    docs = {table.id: table.doc for table in store.tables.all()}
    journals = pushes_of(read_entries(store, machine))
    mine = [journal for number, journal in journals.items() if own(number, docs.get(int(facts(journal).get("table", 0)), {}))]
    return outcome_of(mine[-1], names) if mine else None


def open_push(store: Store, machine: str, control: str = "") -> str:
    """What is open of the last push into a machine's control, as a sentence; empty if nothing is."""
    journals = pushes_of(read_entries(store, machine, control))
    found = outcome_of(journals[max(journals)]) if journals else None
    return found.text if found is not None and found.word == OPEN else ""


def open_pushes(store: Store, machine: str, control: str = "") -> list[str]:
    """The same, and every push of another journal whose table nothing has verified and may be in force: it may be that of this control,
    under another name or address.
    """
    chain, own = store.pushes.chain(machine, control), open_push(store, machine, control)
    others = [p for p in known_tables(store).unverified.values() if p.may_be_active and p.chain != chain]
    return [*filter(None, [own]), *map(_other, others)]


def _other(push: PushedTable) -> str:
    at = f" at {push.control}" if push.control else ""
    what = "its table was never verified; if this is that control, nothing is measured on it"
    return f"push {push.push} of machine {push.machine!r}{at} stands at {push.state}: {what}"


def by_journal(store: Store, machine: str, proposal: int, after: int, said: JobOutcome) -> JobOutcome:
    """What was said of a push, put right by the journal.

    Raises
    ------
    StoreError
        As of `in_force`.
    """
    return put_right(in_force(store, machine, proposal, after), said)


def put_right(found: JobOutcome | None, said: JobOutcome) -> JobOutcome:
    """What was said of a push, and what the journal says (None: nothing of it), as one."""
    if found is None:
        return said if said.word in ("refused", STOPPED) else JobOutcome("failed", said.text)
    if found.word == said.word:
        return said
    word = STOPPED if (found.word, said.word) == ("failed", STOPPED) else found.word
    return JobOutcome(word, f"{found.text}; {said.text}")


def outcome_of(journal: Journal, names: Names = Names()) -> JobOutcome:
    """How a push stands by its journal."""
    last, known = journal[-1], facts(journal)
    name, why = f"push {last.push}", str(known.get("why", ""))
    match last.state:
        case PushState.KEEP:
            return JobOutcome("kept", f"{name}: {names.new} is kept and in force: {known.get('verify', '')}")
        case PushState.ROLLED_BACK:
            return JobOutcome("rolled back", f"{name}: {names.old} is in force again: {why}")
        case PushState.REJECTED:
            return JobOutcome("refused", f"{name}: nothing was written: {'; '.join(known.get('reasons', [])) or why}")
        case PushState.ABORTED:
            return JobOutcome("failed", f"{name}: {names.old} is in force, {names.it} never was: {why}")
        case PushState.ACCEPTED:
            new = known["accepted_crc"] == known["crc"]
            return JobOutcome("kept" if new else "rolled back", f"{name}: a person vouches for {names.new if new else 'another table'}")
        case PushState.OPERATOR:
            return JobOutcome(OPEN, f"{operator_needed(journal)}; a person has to look")
        case state if state in BEFORE_ACTIVATION:
            return JobOutcome(OPEN, f"{name} stands at {state}: {names.old} is in force; the next start closes the journal")
    pending = f" ({known['pending']})" if known.get("pending") else ""
    return JobOutcome(
        OPEN, f"{name} stands at {last.state}{pending}: an unverified table may be in force; it is taken back before anything else"
    )
