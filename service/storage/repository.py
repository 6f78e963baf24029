"""Base of the repositories: read records through their mapping, insert rows."""

from __future__ import annotations

from typing import Any, TypeVar

from sqlalchemy import Column, ColumnElement, Connection, Table, insert
from sqlalchemy.dialects.postgresql import Insert as PostgresInsert
from sqlalchemy.dialects.postgresql import insert as postgres_insert
from sqlalchemy.dialects.sqlite import Insert as SqliteInsert
from sqlalchemy.dialects.sqlite import insert as sqlite_insert

from abbe.service.errors import NotStored
from abbe.service.storage.database import Database
from abbe.service.storage.mapping import RecordMapping

R = TypeVar("R")
Order = ColumnElement[Any]


class Repository:
    """Base of the repositories, one for each aggregate."""

    def __init__(self, database: Database) -> None:
        self._db = database

    def _all(
        self, of: RecordMapping[R], *where: ColumnElement[bool], order: Order | None = None, newest: bool = False, limit: int | None = None
    ) -> list[R]:
        """All records that match, by ``order`` (default: id); with ``newest`` in descending order."""
        by = of.table.c.id if order is None else order
        query = of.select().where(*where).order_by(by.desc() if newest else by).limit(limit)
        return [of.read(row) for row in self._db.read(lambda connection: connection.execute(query).all())]

    def _first(self, of: RecordMapping[R], *where: ColumnElement[bool]) -> R | None:
        """The first record that matches, None if there is none."""
        return next(iter(self._all(of, *where, limit=1)), None)

    def _get(self, of: RecordMapping[R], number: int, what: str, remedy: str = "") -> R:
        """The record of an id. Raises NotStored."""
        found = self._first(of, of.table.c.id == number)
        if found is None:
            raise NotStored(f"no {what} {number} in {self._db.url}", remedy)
        return found

    def _add(self, table: Table, **values: object) -> int:
        """Insert one row in a transaction of its own; return its id."""
        return self._db.commit(lambda connection: insert_row(connection, table, **values))


def insert_row(connection: Connection, table: Table, **values: object) -> int:
    """Insert one row; return its id."""
    key = connection.execute(insert(table).values(**values)).inserted_primary_key
    assert key is not None
    return int(key[0])


def if_given(column: Column[Any], value: object) -> list[ColumnElement[bool]]:
    """The condition that a column equals a value; no condition for None."""
    return [] if value is None else [column == value]


def dialect_insert(connection: Connection, table: Table) -> PostgresInsert | SqliteInsert:
    """An insert with ON CONFLICT clauses, whose syntax differs between databases."""
    return postgres_insert(table) if connection.dialect.name == "postgresql" else sqlite_insert(table)
