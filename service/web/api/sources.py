"""Where the answers of the interface come from, and the questions that many routes ask alike."""

from __future__ import annotations

import json
import math
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Annotated, Any, TypeVar

import structlog
from fastapi import Path, Query
from pydantic import BaseModel, ValidationError
from sqlalchemy.exc import SQLAlchemyError

from abbe.service.clock import Clock
from abbe.service.domain.device_status import DeviceStatus
from abbe.service.domain.schedule import Schedule
from abbe.service.errors import NotStored, StoreError, Unusable
from abbe.service.report.report_parts import Rules
from abbe.service.scheduler.store import ServiceStore
from abbe.service.storage.repositories.pages import LARGEST
from abbe.service.web.core_link.logtail import LogTail

log = structlog.get_logger("abbe.api")
M = TypeVar("M", bound=BaseModel)
Doc = dict[str, Any]

Number = Annotated[int, Path(ge=1, le=LARGEST, description="Its number.")]
Limit = Annotated[int, Query(ge=1, le=200, description="At most so many.")]
Cursor = Annotated[int | None, Query(ge=1, le=LARGEST, description="`next_cursor` of the page before; absent: the newest.")]
Filter = Annotated[str | None, Query(description="Only those that have exactly this.")]


@dataclass(frozen=True)
class Sources:
    """What the interface reads.

    Parameters
    ----------
    store : ServiceStore
        Everything that is kept.
    machine : str
        The machine of this service; the store may know others.
    clock : Clock
        Now.
    schedules : sequence of Schedule
        The timetable.
    devices : callable
        Its devices, and when they were last heard of.
    rules : Rules
        What the machine file adds to reports.
    tail : LogTail, optional
        The latest lines of the log, for the diagnostics.
    control : str
        Identity of the machine's control (`control_of`); empty: not known.
    """

    store: ServiceStore
    machine: str
    clock: Clock
    schedules: Sequence[Schedule] = ()
    devices: Callable[[], Sequence[DeviceStatus]] = tuple
    rules: Rules = field(default_factory=Rules)
    tail: LogTail | None = None
    control: str = ""

    def control_of(self, machine: str) -> str:
        """Identity of a machine's control, where it is the one of this service; else empty."""
        return self.control if machine == self.machine else ""

    def page(self, kind: str, given: Mapping[str, object], cursor: int | None, limit: int) -> tuple[list[Doc], int | None]:
        """Rows of a page, and the cursor of the next one; None: there is none."""
        if any(isinstance(value, str) and not storable(value) for value in given.values()):
            return [], None
        rows = self.store.page(kind, given, cursor, limit + 1)
        return rows[:limit], rows[limit - 1]["id"] if len(rows) > limit else None

    def row(self, kind: str, number: int, what: str) -> Doc:
        """One row with its document.

        Raises
        ------
        NotStored
            There is none.
        """
        found = self.store.row(kind, number)
        if found is None:
            raise NotStored(f"there is no {what} {number}")
        return found


def storable(text: str) -> bool:
    """Whether a text can be in a database at all: NUL and halves of characters cannot, so nothing has such a name."""
    return "\0" not in text and not any("\ud800" <= c <= "\udfff" for c in text)


@contextmanager
def as_stored() -> Iterator[None]:
    """What is wrong with stored data is told as that; a database that does not answer stays what it is.

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


def read_as(model: type[M], doc: object) -> M | None:
    """A stored document as a model of the exchange formats; None: it is of another form."""
    try:
        return model.model_validate_json(json.dumps(finite(doc)))  # by way of JSON: there strict models take lists for tuples
    except ValidationError:
        return None


def finite(value: Any) -> Any:
    """JSON knows no NaN: what is no number becomes null."""
    if isinstance(value, dict):
        return {key: finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
