"""Documents: JSON as it is stored or sent, within limits, parsed into a record once, where it is read."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

from pydantic import Field, TypeAdapter, ValidationError

from abbe.service.errors import Unusable, mistakes

Doc = dict[str, Any]
"""A JSON object."""
GENESIS = "0" * 64
"""Stands for the digest of the previous entry in the first entry of a hash chain."""
T = TypeVar("T")
WORD, TEXT = 200, 4000
"""Longest texts: the channel between the two processes refuses longer ones and larger numbers (`Number`)."""
Word = Annotated[str, Field(max_length=WORD)]
Text = Annotated[str, Field(max_length=TEXT)]
Number = Annotated[int, Field(ge=0, le=2**62)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """Fields that the database adds when it stores a record: number and time (UTC); 0 and empty before that."""

    id: int = 0
    created_utc: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class DocumentRow(Row):
    """A row that holds a document."""

    doc: Doc


@dataclass(frozen=True, slots=True, kw_only=True)
class HistoryLine:
    """One line of a history that only grows: never changed after writing; ``seq`` counts from 0.

    ``id``: 0 before it is stored.
    """

    id: int = 0
    seq: int
    utc: str


@dataclass(frozen=True, slots=True, kw_only=True)
class HistoryRow(HistoryLine):
    """A line of a history that holds a document."""

    doc: Doc


_adapters: dict[type[Any], TypeAdapter[Any]] = {}


def _adapter(kind: type[Any]) -> TypeAdapter[Any]:
    if kind not in _adapters:
        _adapters[kind] = TypeAdapter(kind)
    return _adapters[kind]


def document(record: Any, *, stated_only: bool = False) -> Doc:
    """Turn a record (a dataclass) into a JSON object; ``stated_only``: without fields that have their default."""
    doc: Doc = _adapter(type(record)).dump_python(record, mode="json", by_alias=True, exclude_defaults=stated_only)
    return doc


def record(kind: type[T], doc: object, what: str) -> T:
    """Parse a stored JSON object into a record; ``what`` names it in the error.

    Raises
    ------
    Unusable
        The document has another form.
    """
    try:
        return parsed(kind, doc)
    except ValueError as error:
        raise Unusable(f"{what} does not have the expected content: {error}", "make it again with this version of Abbe") from None


def parsed(kind: type[T], doc: object) -> T:
    """Parse a JSON object into a record. Raises ValueError with the first mistake on one line."""
    try:
        found: T = _adapter(kind).validate_python(doc)
    except ValidationError as error:
        first = mistakes(error.errors())[0]
        raise ValueError(f"{first.path}: {first.message}") from None
    return found


def canonical(value: object) -> bytes:
    """Canonical JSON for hashing: sorted keys, no blanks. Raises ValueError for NaN and Inf."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=False).encode()
