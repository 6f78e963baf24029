"""How rows become records: a field of a record is the column of its name, unless its mapping names another column or a record inside."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from typing import Any, Generic, TypeVar

from sqlalchemy import Column, ColumnElement, FromClause, Row, Select, Table, select

R = TypeVar("R")


class RecordMapping(Generic[R]):
    """A frozen record and the columns that it is read from and written to.

    SQLAlchemy's own mapper writes its state into the object and refuses frozen ones (decision 0037).

    Parameters
    ----------
    record : type
        A dataclass.
    table : Table
        Where its rows stand.
    source : FromClause, optional
        What is read, where that is more than the table.
    **other : ColumnElement or RecordMapping
        Fields that are not the column of their name: another expression, or a record of several columns.
    """

    def __init__(
        self, record: type[R], table: Table, source: FromClause | None = None, **other: ColumnElement[Any] | RecordMapping[Any]
    ) -> None:
        assert is_dataclass(record)
        self.table, self._source = table, table if source is None else source
        self._make: Callable[..., R] = record
        self._prefix = f"{table.name}_{record.__name__}_"
        names = [one.name for one in fields(record)]
        if missing := [name for name in names if name not in other and name not in table.c]:
            raise TypeError(f"{record.__name__}: table {table.name} has no column {', '.join(missing)}")
        self._fields = {name: other[name] if name in other else table.c[name] for name in names}

    @property
    def columns(self) -> list[ColumnElement[Any]]:
        """What has to be selected for `read`."""
        found: list[ColumnElement[Any]] = []
        for name, column in self._fields.items():
            found += column.columns if isinstance(column, RecordMapping) else [column.label(self._prefix + name)]
        return found

    def select(self) -> Select[Any]:
        """All rows, in no order."""
        return select(*self.columns).select_from(self._source)

    def read(self, row: Row[*tuple[Any, ...]]) -> R:
        """The record of a row that holds `columns`, and maybe others."""
        return self.from_values(row._mapping)  # noqa: SLF001 - SQLAlchemy's public name

    def from_values(self, values: Mapping[Any, Any]) -> R:
        """The record of values by the names of `columns`."""
        return self._make(
            **{
                name: column.from_values(values) if isinstance(column, RecordMapping) else values[self._prefix + name]
                for name, column in self._fields.items()
            }
        )

    def values(self, record: R, *without: str) -> dict[str, Any]:
        """The columns of a record that its table stores, by their names; ``without``: fields that are given elsewhere."""
        found: dict[str, Any] = {}
        for name, column in self._fields.items():
            if isinstance(column, RecordMapping):
                found |= column.values(getattr(record, name))
            elif isinstance(column, Column) and column.table is self.table and name not in without:
                found[column.name] = getattr(record, name)
        return found
