"""The pushes of a machine as its journal tells them, checked: for whoever reads, and has no way to a control."""

from __future__ import annotations

from service.errors import StoreError
from service.push.entries import Entry, Journal, JournalBroken, check_chain
from service.push.states import State

KIND = "rollback"
"""Kind of a table that a person ordered back."""


def pushes_of(entries: list[Entry]) -> dict[int, Journal]:
    """Journals of all pushes of a machine, by number.

    Raises
    ------
    StoreError
        The chain is broken: an entry was changed, removed or swapped.
    """
    try:
        check_chain(entries)
    except JournalBroken as error:
        raise StoreError(f"the push journal is not what was written: {error}", "restore the database from a backup") from None
    numbers = sorted({e.push for e in entries})
    return {n: tuple(e for e in entries if e.push == n) for n in numbers}


def push_log(journal: Journal) -> tuple[str, ...]:
    """Every transition of a push as a line for people."""
    lines = []
    for entry in journal:
        words = [str(entry.doc[key]) for key in ("why", "pending", "again", "approved_by", "probe", "verify") if entry.doc.get(key)]
        if entry.state is State.SNAPSHOT:
            words = [f"bank {entry.doc['base_bank']}, CRC {entry.doc['base_crc']:08X}; to come: CRC {entry.doc['crc']:08X}"]
        lines.append(": ".join([str(entry.state), *words]) + f" ({entry.utc})")
    return tuple(lines)
