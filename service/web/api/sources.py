"""Sources of the data behind `/api/v1`, and parameters that many routes share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Annotated

from fastapi import Path, Query

from abbe.service.domain.machine import Rules
from abbe.service.domain.machine_file import MachineFileSummary
from abbe.service.domain.progress import DeviceStatus
from abbe.service.domain.schedule import Schedule
from abbe.service.queries.reader import Reader
from abbe.service.storage.repositories.pages import LARGEST
from abbe.service.web.core_link.logtail import LogTail

Number = Annotated[int, Path(ge=1, le=LARGEST, description="Number of the object.")]
Limit = Annotated[int, Query(ge=1, le=200, description="Largest number of rows.")]
Cursor = Annotated[int | None, Query(ge=1, le=LARGEST, description="`next_cursor` of the previous page; absent: the newest.")]
Filter = Annotated[str | None, Query(description="Exact match.")]


@dataclass(frozen=True, kw_only=True)
class Sources:
    """Sources of the data behind `/api/v1`.

    ``devices`` returns the devices with their last state; ``rules``: limits and certificates of the machine file; ``tail``: the latest log
    lines, for the diagnostics; ``stated``: the machine file with its lines.
    """

    reader: Reader
    schedules: Sequence[Schedule] = ()
    devices: Callable[[], Sequence[DeviceStatus]] = tuple
    rules: Rules = field(default_factory=Rules)
    tail: LogTail | None = None
    stated: MachineFileSummary | None = None
