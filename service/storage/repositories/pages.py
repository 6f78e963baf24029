"""Store methods that read lists a page at a time, newest first, without their heavy documents: histories grow for years."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, FromClause, Select, func, select

from abbe.service.domain.document import Doc
from abbe.service.domain.measured import INCOMPLETE, RUNNING, ChannelRecord, ChunkRecord
from abbe.service.domain.owner import Owner
from abbe.service.storage.base import StoreBase
from abbe.service.storage.tables import (
    campaigns,
    chunks,
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
"""Numbers of rows are not larger on any database."""


@dataclass(frozen=True, slots=True)
class Listing:
    """One kind of list: its columns by their names outside, where they come from, and which of them may be asked for."""

    columns: Mapping[str, ColumnElement[Any]]
    source: FromClause
    filters: tuple[str, ...] = ()

    def query(self) -> Select[Any]:
        """All rows, in no order."""
        return select(*(column.label(name) for name, column in self.columns.items())).select_from(self.source)


def _of(table: Any, *names: str) -> dict[str, ColumnElement[Any]]:
    return {name: table.c[name] for name in names}


_MACHINE = {"machine": machines.c.name}
_CAMPAIGN = {"campaign": campaigns.c.name}
_CAMPAIGNS = campaigns.join(machines, machines.c.id == campaigns.c.machine_id)
_RUN = [column.name for column in runs.c if not column.name.endswith("_doc")]


def _in_campaign(table: Any) -> FromClause:
    found: FromClause = table.join(campaigns, campaigns.c.id == table.c.campaign_id).join(machines, machines.c.id == campaigns.c.machine_id)
    return found


LISTINGS: dict[str, Listing] = {
    "machines": Listing(_of(machines, "id", "name", "doc", "created_utc"), machines, ("name",)),
    "campaigns": Listing(_of(campaigns, "id", "name", "created_utc") | _MACHINE, _CAMPAIGNS, ("machine",)),
    "runs": Listing(_of(runs, *_RUN) | _CAMPAIGN | _MACHINE, _in_campaign(runs), ("campaign", "machine", "test", "role", "status")),
    "solutions": Listing(
        _of(solutions, "id", "kind", "run_ids", "created_utc") | _CAMPAIGN | _MACHINE, _in_campaign(solutions), ("campaign", "machine")
    ),
    "discoveries": Listing(
        _of(discoveries, "id", "created_utc") | _CAMPAIGN | _MACHINE, _in_campaign(discoveries), ("campaign", "machine")
    ),
    "proposals": Listing(_of(proposals, "id", "machine", "solution_id", "created_utc"), proposals, ("machine",)),
    "pushes": Listing(
        _of(push_entries, "id", "machine", "push", "seq", "state", "utc", "prev", "digest"), push_entries, ("machine", "push", "state")
    ),
    "verifications": Listing(
        _of(verifications, "id", "verdict", "utc", "doc") | _MACHINE,
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


class PageStore(StoreBase):
    """Lists a page at a time."""

    def page(self, kind: str, given: Mapping[str, object], before: int | None, limit: int) -> list[Doc]:
        """Read the newest rows of a list.

        Parameters
        ----------
        kind : str
            One of `LISTINGS`.
        given : mapping
            Columns and what they have to be; None is not asked for.
        before : int, optional
            Only rows with a smaller number: the last number of the page before.
        limit : int
            At most so many.
        """
        listing = LISTINGS[kind]
        query = listing.query().order_by(listing.columns["id"].desc()).limit(limit)
        for name in listing.filters:
            if given.get(name) is not None:
                query = query.where(listing.columns[name] == given[name])
        if before is not None:
            query = query.where(listing.columns["id"] < before)
        return [dict(row._mapping) for row in self._read(lambda connection: connection.execute(query).all())]  # noqa: SLF001 - public name

    def row(self, kind: str, number: int) -> Doc | None:
        """One row of a list with its document as ``doc``, where it has one; None: there is none."""
        listing = LISTINGS[kind]
        query = listing.query().where(listing.columns["id"] == number)
        if kind in _DOCUMENTS:
            query = query.add_columns(_DOCUMENTS[kind].c.doc.label("doc"))
        found = self._read(lambda connection: connection.execute(query).first())
        return None if found is None else dict(found._mapping)  # noqa: SLF001 - public name

    def channels(self, run_id: int) -> list[ChannelRecord]:
        """What a run holds, channel by channel."""
        columns = (chunks.c.channel, func.min(chunks.c.codec), func.count(), func.sum(chunks.c.n))
        query = select(*columns).where(chunks.c.run_id == run_id).group_by(chunks.c.channel).order_by(chunks.c.channel)
        rows = self._read(lambda connection: connection.execute(query).all())
        return [ChannelRecord(channel, codec, int(count), int(n)) for channel, codec, count, n in rows]

    def chunk_sizes(self, run_id: int, channel: str) -> list[tuple[int, int]]:
        """Number and samples of every chunk of a channel, in order; payloads are not read."""
        query = select(chunks.c.seq, chunks.c.n).where(chunks.c.run_id == run_id, chunks.c.channel == channel).order_by(chunks.c.seq)
        return [(int(seq), int(n)) for seq, n in self._read(lambda connection: connection.execute(query).all())]

    def chunk_range(self, run_id: int, channel: str, first: int, last: int) -> list[ChunkRecord]:
        """Chunks ``first`` to ``last`` of a channel, with their payloads, in order."""
        columns = [chunks.c[name] for name in ChunkRecord.__dataclass_fields__]
        query = select(*columns).where(chunks.c.run_id == run_id, chunks.c.channel == channel, chunks.c.seq.between(first, last))
        rows = self._read(lambda connection: connection.execute(query.order_by(chunks.c.seq)).all())
        return [ChunkRecord(*row) for row in rows]


def visible_status(row: Doc) -> str:
    """What a person should be told of a run's state: as `RunRecord.visible_status`."""
    owner = Owner(row["owner_host"], row["owner_pid"], row["owner_start"])
    return INCOMPLETE if row["status"] == RUNNING and owner.is_gone() else str(row["status"])
