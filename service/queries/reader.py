"""The source of every query: paging, and conversion of stored documents into records."""

from __future__ import annotations

import json
import math
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError
from sqlalchemy.exc import SQLAlchemyError

from abbe.service.clock import Clock
from abbe.service.errors import NotStored, StoreError, Unusable
from abbe.service.storage.repositories.pages import PageRow
from abbe.service.storage.store import Store

T = TypeVar("T")
MOST = 200
"""Default number of rows in a page."""


@dataclass(frozen=True)
class Reader:
    """Reads a store for one service.

    Parameters
    ----------
    store : Store
        The database; it may contain other machines.
    machine : str
        The machine of this service; empty for a command that only has a database.
    clock : Clock
        Clock of the service.
    control : str
        Identity of the machine's control (`control_of`); empty: not known.
    """

    store: Store
    machine: str
    clock: Clock
    control: str = ""

    @property
    def now_s(self) -> float:
        """Now, seconds since 1970 UTC."""
        return self.clock.utc().timestamp()

    def control_of(self, machine: str) -> str:
        """Return the identity of a machine's control; empty for machines of other services."""
        return self.control if machine == self.machine else ""

    def page(
        self, kind: str, filters: Mapping[str, object], cursor: int | None = None, limit: int = MOST
    ) -> tuple[list[PageRow], int | None]:
        """Return the rows of a page, newest first, and the cursor of the next page; None: this is the last page."""
        if any(isinstance(value, str) and not storable(value) for value in filters.values()):
            return [], None
        rows = self.store.pages.page(kind, filters, cursor, limit + 1)
        return rows[:limit], rows[limit - 1].number if len(rows) > limit else None

    def row(self, kind: str, number: int, what: str) -> PageRow:
        """Return one row with its document; ``what`` names the kind of object in the error. Raises NotStored."""
        found = self.store.pages.row(kind, number)
        if found is None:
            raise NotStored(f"there is no {what} {number}")
        return found


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredResult:
    """Fields that every list of results has. ``number``: identifies the result in requests."""

    number: int
    campaign: str
    machine: str
    created_utc: str


def of_row(kind: type[T], row: PageRow, **known: Any) -> T:
    """Convert a row of the store to a record: fields have the names of columns; ``known`` overrides the row."""
    values = {"number": row.number, "id": row.number, "doc": row.doc, **row.columns, **known}
    return kind(**{one.name: values[one.name] for one in fields(kind) if one.name in values})  # type: ignore[arg-type]


def json_value(value: object) -> Any:
    """Convert a record to the JSON value that HTTP and ``--json`` write."""
    return _ADAPTERS(type(value)).dump_python(value, mode="json")


def read_as(kind: type[T], doc: object) -> T | None:
    """Convert a stored document to a record; None if it has another form."""
    try:
        found: T = _ADAPTERS(kind).validate_json(json.dumps(finite(doc)))  # via JSON, where strict models accept lists for tuples
    except ValidationError:
        return None
    return found


_ADAPTERS: Callable[[Any], TypeAdapter[Any]] = cache(TypeAdapter)


def storable(text: str) -> bool:
    """Whether a database can store a text: it cannot store NUL or lone surrogates."""
    return "\0" not in text and not any("\ud800" <= c <= "\udfff" for c in text)


@contextmanager
def as_stored() -> Iterator[None]:
    """Turn errors of stored data into `Unusable`; a database that does not answer stays a `StoreError`.

    Raises
    ------
    NotStored
        The store lacks a requested or referenced object.
    Unusable
        The data cannot be used.
    """
    try:
        yield
    except NotStored:
        raise
    except StoreError as error:
        if isinstance(error.__cause__, SQLAlchemyError):
            raise
        raise Unusable(error.detail, error.remedy) from error
    except (KeyError, TypeError, ValueError, IndexError) as error:
        # Documents may be imported or written by an older version. A defect of this program would look the same, hence the log.
        import structlog  # it takes as long as the rest of a short command

        at = traceback.extract_tb(error.__traceback__)[-1]
        structlog.get_logger("abbe.queries").warning(
            "stored data cannot be used", error=repr(error)[:200], where=f"{at.filename}:{at.lineno}"
        )
        what = f"{type(error).__name__}: {error}"[:200]
        raise Unusable(f"stored data are incomplete or malformed ({what})", "see the service's log") from error


def finite(value: Any) -> Any:
    """Convert a value for JSON, which has no NaN: non-finite numbers become null."""
    if isinstance(value, dict):
        return {key: finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
