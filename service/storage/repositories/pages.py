"""Lists in pages, newest first, without their large documents: histories grow for years."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

from sqlalchemy import ColumnElement, FromClause, Select, select

from abbe.service.domain.document import Doc
from abbe.service.storage.database import Repository
from abbe.service.storage.tables import (
    campaigns,
    comp_tables,
    discoveries,
    machines,
    proposals,
    push_entries,
    runs,
    solutions,
    verifications,
)

LARGEST = 2**31 - 1
"""The largest row id of any database."""


@dataclass(frozen=True, slots=True)
class Listing:
    """One kind of list: its columns by their public names, the FROM clause, and the columns that may be filtered."""

    columns: Mapping[str, ColumnElement[Any]]
    source: FromClause
    filters: tuple[str, ...] = ()

    def query(self) -> Select[Any]:
        """All rows, in no order."""
        return select(*(column.label(name) for name, column in self.columns.items())).select_from(self.source)

    @property
    def number(self) -> ColumnElement[int]:
        """The number of a row."""
        return self.columns["number"]


@dataclass(frozen=True, slots=True)
class PageRow:
    """One row of a list; ``columns``: values by the columns' public names; ``doc``: its document, None if it was not read."""

    number: int
    columns: Mapping[str, Any]
    doc: Doc | None = None

    @classmethod
    def of(cls, *, number: int, doc: Doc | None = None, **columns: Any) -> Self:
        """A row of the database."""
        return cls(number, columns, doc)


def _of(table: Any, *names: str, **renamed: str) -> dict[str, ColumnElement[Any]]:
    """The number and columns of a table; ``renamed``: names in the table by public name."""
    return {"number": table.c.id} | {name: table.c[name] for name in names} | {name: table.c[column] for name, column in renamed.items()}


_MACHINE = {"machine": machines.c.name}
_CAMPAIGN = {"campaign": campaigns.c.name}
_CAMPAIGNS = campaigns.join(machines, machines.c.id == campaigns.c.machine_id)
_RUN = [column.name for column in runs.c if not column.name.endswith("_doc") and column.name not in ("id", "label")]


def _in_campaign(table: Any) -> FromClause:
    found: FromClause = table.join(campaigns, campaigns.c.id == table.c.campaign_id).join(machines, machines.c.id == campaigns.c.machine_id)
    return found


LISTINGS: dict[str, Listing] = {
    "machines": Listing(_of(machines, "name", "doc", "created_utc"), machines, ("name",)),
    "campaigns": Listing(_of(campaigns, "name", "created_utc") | _MACHINE, _CAMPAIGNS, ("machine",)),
    "runs": Listing(
        _of(runs, *_RUN, run_id="label") | _CAMPAIGN | _MACHINE, _in_campaign(runs), ("campaign", "machine", "test", "role", "status")
    ),
    "solutions": Listing(
        _of(solutions, "kind", "created_utc", runs="run_ids") | _CAMPAIGN | _MACHINE, _in_campaign(solutions), ("campaign", "machine")
    ),
    "discoveries": Listing(_of(discoveries, "created_utc") | _CAMPAIGN | _MACHINE, _in_campaign(discoveries), ("campaign", "machine")),
    "proposals": Listing(_of(proposals, "machine", "created_utc", solution="solution_id"), proposals, ("machine",)),
    "pushes": Listing(
        _of(push_entries, "machine", "push", "seq", "state", "utc", "prev", "digest"), push_entries, ("machine", "push", "state")
    ),
    "verifications": Listing(
        _of(verifications, "verdict", "utc", "doc") | _MACHINE,
        verifications.join(machines, machines.c.id == verifications.c.machine_id),
        ("machine", "verdict"),
    ),
}
_DOCUMENTS: dict[str, Any] = {
    "campaigns": campaigns,
    "solutions": solutions,
    "discoveries": discoveries,
    "proposals": proposals,
    "pushes": push_entries,
    "tables": comp_tables,
}


class Pages(Repository):
    """Lists in pages."""

    def page(self, kind: str, filters: Mapping[str, object], before: int | None, limit: int) -> list[PageRow]:
        """Read one page of a list, one of `LISTINGS`.

        ``filters``: required values by column, None for any; ``before``: id of the last row of the page before, None for the first page.
        """
        listing = LISTINGS[kind]
        conditions = [listing.columns[name] == filters[name] for name in listing.filters if filters.get(name) is not None]
        conditions += [] if before is None else [listing.number < before]
        query = listing.query().where(*conditions).order_by(listing.number.desc()).limit(limit)
        return [PageRow.of(**row) for row in self._db.read(lambda connection: connection.execute(query).mappings().all())]

    def row(self, kind: str, number: int) -> PageRow | None:
        """One row of a list with its document as ``doc``, if it has one; None: there is no such row."""
        listing = LISTINGS[kind]
        query = listing.query().where(listing.number == number)
        if kind in _DOCUMENTS:
            query = query.add_columns(_DOCUMENTS[kind].c.doc.label("doc"))
        found = self._db.read(lambda connection: connection.execute(query).mappings().first())
        return None if found is None else PageRow.of(**found)
