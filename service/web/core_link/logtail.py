"""The latest log lines of this process in memory, so that the diagnostics need no access to log files."""

from __future__ import annotations

import logging
from collections import deque

from abbe.service.secrets import mask_secrets, visible

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
