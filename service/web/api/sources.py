"""Where the answers of the interface come from, and the parameters that many routes have."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Annotated

from fastapi import Path, Query

from abbe.service.domain.device_status import DeviceStatus
from abbe.service.domain.schedule import Schedule
from abbe.service.queries.reader import Reader
from abbe.service.report.report_parts import Rules
from abbe.service.storage.repositories.pages import LARGEST
from abbe.service.web.core_link.logtail import LogTail

Number = Annotated[int, Path(ge=1, le=LARGEST, description="Its number.")]
Limit = Annotated[int, Query(ge=1, le=200, description="At most so many.")]
Cursor = Annotated[int | None, Query(ge=1, le=LARGEST, description="`next_cursor` of the page before; absent: the newest.")]
Filter = Annotated[str | None, Query(description="Only those that have exactly this.")]


@dataclass(frozen=True, kw_only=True)
class Sources:
    """What the interface reads.

    Parameters
    ----------
    reader : Reader
        The store, the machine of this service, and now.
    schedules : sequence of Schedule
        The timetable.
    devices : callable
        Its devices, and when they were last heard of.
    rules : Rules
        What the machine file adds to reports.
    tail : LogTail, optional
        The latest lines of the log, for the diagnostics.
    """

    reader: Reader
    schedules: Sequence[Schedule] = ()
    devices: Callable[[], Sequence[DeviceStatus]] = tuple
    rules: Rules = field(default_factory=Rules)
    tail: LogTail | None = None
