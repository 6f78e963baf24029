"""What every query reads from, how it pages, and how documents from the store become records."""

from __future__ import annotations

import json
import math
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, TypeVar

import structlog
from pydantic import TypeAdapter, ValidationError
from sqlalchemy.exc import SQLAlchemyError

from abbe.service.clock import Clock
from abbe.service.errors import NotStored, StoreError, Unusable
from abbe.service.storage.store import Store

log = structlog.get_logger("abbe.queries")
T = TypeVar("T")
Doc = dict[str, Any]
MOST = 200
"""Rows of a page, unless a query says otherwise."""


@dataclass(frozen=True)
class Reader:
    """A store, and whose service reads it.

    Parameters
    ----------
    store : Store
        Everything that is kept; it may know other machines.
    machine : str
        The machine of this service; empty for a command that only has a database.
    clock : Clock
        Now.
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
        """Identity of a machine's control, where it is the one of this service; else empty."""
        return self.control if machine == self.machine else ""

    def page(self, kind: str, given: Mapping[str, object], cursor: int | None = None, limit: int = MOST) -> tuple[list[Doc], int | None]:
        """Rows of a page, newest first, and the cursor of the next one; None: there is none."""
        if any(isinstance(value, str) and not storable(value) for value in given.values()):
            return [], None
        rows = self.store.pages.page(kind, given, cursor, limit + 1)
        return rows[:limit], rows[limit - 1]["id"] if len(rows) > limit else None

    def row(self, kind: str, number: int, what: str) -> Doc:
        """One row with its document.

        Raises
        ------
        NotStored
            There is none.
        """
        found = self.store.pages.row(kind, number)
        if found is None:
            raise NotStored(f"there is no {what} {number}")
        return found


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredResult:
    """What every result of a campaign has in its list. ``number``: by which it is asked for."""

    number: int
    campaign: str
    machine: str
    created_utc: str


def of_row(kind: type[T], row: Mapping[str, Any], **known: Any) -> T:
    """A row of the store as a record: every field has the name of its column, ``number`` that of ``id``; ``known`` comes first."""
    values = {"number": row["id"], **row, **known}
    return kind(**{one.name: values[one.name] for one in fields(kind) if one.name in values})  # type: ignore[arg-type]


def json_value(value: object) -> Any:
    """A record as a JSON value: what HTTP and ``--json`` write."""
    return _ADAPTERS(type(value)).dump_python(value, mode="json")


def read_as(kind: type[T], doc: object) -> T | None:
    """A stored document as a record; None: it is of another form."""
    try:
        found: T = _ADAPTERS(kind).validate_json(json.dumps(finite(doc)))  # by way of JSON: there strict models take lists for tuples
    except ValidationError:
        return None
    return found


_ADAPTERS: Callable[[Any], TypeAdapter[Any]] = cache(TypeAdapter)


def storable(text: str) -> bool:
    """Whether a database can hold a text at all: NUL and halves of characters cannot be stored, so nothing has such a name."""
    return "\0" not in text and not any("\ud800" <= c <= "\udfff" for c in text)


@contextmanager
def as_stored() -> Iterator[None]:
    """Turn errors of stored data into `Unusable`; a database that does not answer stays a `StoreError`.

    Raises
    ------
    NotStored
        Something that is asked for, or that the data name, is not there.
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
        # Documents are whatever somebody has imported or an older version has written. A defect of ours would look the same: it is logged.
        at = traceback.extract_tb(error.__traceback__)[-1]
        log.warning("stored data cannot be used", error=repr(error)[:200], where=f"{at.filename}:{at.lineno}")
        what = f"{type(error).__name__}: {error}"[:200]
        raise Unusable(f"what is stored lacks or garbles something ({what})", "the service's log says where") from error


def finite(value: Any) -> Any:
    """JSON knows no NaN: what is no number becomes null."""
    if isinstance(value, dict):
        return {key: finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
