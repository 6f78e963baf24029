"""Sources of the data behind `/api/v1`, and parameters that many routes share.

One source is the latest log lines of this process in memory, so that the diagnostics need no access to log files.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Annotated

from fastapi import Path, Query

from abbe.service.domain.machine import Rules
from abbe.service.domain.machine_file import MachineFileSummary
from abbe.service.domain.progress import DeviceStatus
from abbe.service.domain.schedule import Schedule
from abbe.service.queries.reader import Reader
from abbe.service.secrets import mask_secrets, visible
from abbe.service.storage.repositories.pages import LARGEST

Number = Annotated[int, Path(ge=1, le=LARGEST, description="Number of the object.")]
Limit = Annotated[int, Query(ge=1, le=200, description="Largest number of rows.")]
Cursor = Annotated[int | None, Query(ge=1, le=LARGEST, description="`next_cursor` of the previous page; absent: the newest.")]
Filter = Annotated[str | None, Query(description="Exact match.")]
KEPT = 300
LONGEST = 2000


class LogTail(logging.Handler):
    """Keeps the latest `KEPT` records, one line each, without passwords in URLs."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self._lines: deque[str] = deque(maxlen=KEPT)

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a record in the format of the log."""
        try:
            self._lines.append(visible(mask_secrets(self.format(record)))[:LONGEST])
        except (TypeError, ValueError, KeyError, RecursionError):  # a record that cannot be formatted must not stop the caller
            self.handleError(record)

    def lines(self) -> list[str]:
        """The kept lines, oldest first."""
        return list(self._lines)


def capture_log() -> LogTail:
    """Add a log tail to the root logger, with the format of the existing handler."""
    tail, root = LogTail(), logging.getLogger()
    if root.handlers and root.handlers[0].formatter is not None:
        tail.setFormatter(root.handlers[0].formatter)
    root.addHandler(tail)
    return tail


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
