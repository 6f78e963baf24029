"""The push journal, and the table in force with its history."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from abbe.service.domain.decisions import PushTransition
from abbe.service.queries.reader import Reader, of_row
from abbe.service.tables.push_journal import JournalView, TableHistory


@dataclass(frozen=True, slots=True, kw_only=True)
class PushEntry(PushTransition):
    """One transition of a push in the journal of a machine, chained to the entry before it."""

    number: int


@dataclass(frozen=True, slots=True, kw_only=True)
class PushEntryDetail(PushEntry):
    """An entry with the facts that it recorded; tables are hexadecimal images."""

    known: dict[str, Any]


def push_entries(
    reader: Reader, machine: str | None, push: int | None, state: str | None, cursor: int | None, limit: int
) -> tuple[list[PushEntry], int | None]:
    """The push journal, newest entry first; a renamed machine keeps its journal under the first name."""
    journal = machine and reader.store.pushes.chain(machine, reader.control_of(machine))
    rows, after = reader.page("pushes", {"machine": journal, "push": push, "state": state}, cursor, limit)
    return [of_row(PushEntry, row) for row in rows], after


def push_entry(reader: Reader, number: int) -> PushEntryDetail:
    """One entry of the journal with the facts that it recorded. Raises NotStored."""
    row = reader.row("pushes", number, "entry of a push")
    return of_row(PushEntryDetail, row, known=row["doc"])


def tables(reader: Reader) -> TableHistory:
    """The table in force on this service's machine, its pushes, and the possible rollback. Raises JournalChanged."""
    return JournalView.read(reader.store, reader.machine, reader.control).history()
