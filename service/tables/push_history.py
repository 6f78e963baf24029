"""The pushes of a machine as its journal tells them, checked: for whoever reads, and has no way to a control."""

from __future__ import annotations

from abbe.service.errors import JournalChanged, TableMismatch, TableRefused
from abbe.service.push.entries import WORD, Journal, JournalBroken, JournalEntry, check_chain, facts
from abbe.service.push.states import TERMINAL, PushState

KIND = "rollback"
"""Kind of a table that a person ordered back."""
STILL_ACTIVE = "the unverified table is STILL ACTIVE"


def pushes_of(entries: list[JournalEntry]) -> dict[int, Journal]:
    """Journals of all pushes of a machine, by number; a person's word before the first is none.

    Raises
    ------
    JournalChanged
        The chain is broken: an entry was changed, removed or swapped.
    """
    try:
        check_chain(entries)
    except JournalBroken as error:
        raise JournalChanged(f"the push journal is not what was written: {error}", "restore the database from a backup") from None
    numbers = sorted({e.push for e in entries} - {WORD})
    return {n: tuple(e for e in entries if e.push == n) for n in numbers}


def ended_as(journal: Journal) -> PushState:
    """The state in which a push stands or came to its end: a person's word for a table, given later, changes nothing of that."""
    return next((e.state for e in reversed(journal) if e.state is not PushState.ACCEPTED), PushState.ACCEPTED)


def push_log(journal: Journal) -> tuple[str, ...]:
    """Every transition of a push as a line for people."""
    lines = []
    for entry in journal:
        words = [str(entry.doc[key]) for key in ("why", "pending", "again", "approved_by", "probe", "verify") if entry.doc.get(key)]
        if entry.state is PushState.SNAPSHOT:
            words = [f"bank {entry.doc['base_bank']}, CRC {entry.doc['base_crc']:08X}; to come: CRC {entry.doc['crc']:08X}"]
        lines.append(": ".join([str(entry.state), *words]) + f" ({entry.utc})")
    return tuple(lines)


def wanted_by(entries: list[JournalEntry]) -> tuple[int | None, bool]:
    """Return the CRC that should be in force by the entries of all pushes of a machine, in the order of writing, and whether the last push
    has come to its end. None: no push yet, or it is under way.

    A push that came to nothing vouches for nothing: the table that it found in force may be a strange one.
    """
    if not entries:
        return None, True
    last = entries[-1]
    if last.state not in TERMINAL or last.state is PushState.OPERATOR:
        return None, False
    for entry in reversed(entries):
        if entry.state is PushState.ACCEPTED:
            return int(entry.doc["accepted_crc"]), True
        if entry.state is PushState.KEEP:
            return int(facts(tuple(e for e in entries if e.push == entry.push))["crc"]), True
    return next((int(e.doc["base_crc"]) for e in entries if "base_crc" in e.doc), None), True


def last_kept(entries: list[JournalEntry], rollbacks: frozenset[int]) -> Journal:
    """The last push of a machine that was kept and can be taken back. ``rollbacks``: numbers of the tables that persons ordered back.

    Raises
    ------
    TableRefused
        None was kept, or it was a rollback itself.
    """
    kept = [j for j in pushes_of(entries).values() if ended_as(j) is PushState.KEEP]
    if not kept:
        raise TableRefused("no push of this machine was kept: there is nothing to take back", "nothing was written")
    last = kept[-1]
    if int(facts(last).get("table", 0)) in rollbacks:
        raise TableRefused(
            f"the last kept push ({last[-1].push}) was a rollback itself",
            "say how far with abbe comp rollback MACHINE.toml --to PUSH; nothing was written",
        )
    return last


def operator_needed(journal: Journal, detail: str = "") -> TableMismatch:
    """What a person has to know whom the machine calls: why, and whether the table that nobody has verified is the one in force."""
    known = facts(journal)
    why = str(known.get("why", ""))
    cause = f"{detail}; {why}" if detail and detail != why else why
    says = known.get("controller", {})
    if says and says["crc"][says["active"]] == known["crc"]:
        return TableMismatch(
            f"push {journal[-1].push}: {cause}: {STILL_ACTIVE} (CRC {known['crc']:08X})",
            "do not machine; restore the old table at the controller, or vouch for this one with `abbe accept-table MACHINE.toml`",
        )
    return TableMismatch(
        f"push {journal[-1].push}: {cause}", "look at the controller; if its table is right, say so with `abbe accept-table MACHINE.toml`"
    )
