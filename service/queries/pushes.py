"""The push journal, and the table in force with its history."""

from __future__ import annotations

from abbe.service.domain.push_entry import PushEntry, PushState, PushTransition
from abbe.service.queries.reader import Reader, of_row
from abbe.service.tables.push_journal import JournalView, TableHistory


def push_entries(
    reader: Reader, machine: str | None, push: int | None, state: str | None, cursor: int | None, limit: int
) -> tuple[list[PushTransition], int | None]:
    """The push journal, newest entry first; a renamed machine keeps its journal under the first name."""
    journal = machine and reader.store.pushes.chain(machine, reader.control_of(machine))
    rows, after = reader.page("pushes", {"machine": journal, "push": push, "state": state}, cursor, limit)
    return [of_row(PushTransition, row, state=PushState(row["state"])) for row in rows], after


def push_entry(reader: Reader, number: int) -> PushEntry:
    """One entry of the journal with the facts that it recorded. Raises NotStored."""
    row = reader.row("pushes", number, "entry of a push")
    return of_row(PushEntry, row, state=PushState(row["state"]))


def tables(reader: Reader) -> TableHistory:
    """The table in force on this service's machine, its pushes, and the possible rollback. Raises JournalChanged."""
    return JournalView.read(reader.store, reader.machine, reader.control).history()
