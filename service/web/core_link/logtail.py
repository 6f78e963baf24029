"""The latest lines of this process's log, for the diagnostics: kept in memory, so that no reader needs access to the log files."""

from __future__ import annotations

import logging
from collections import deque

from abbe.service.secrets import mask_secrets, visible

KEPT = 300
LONGEST = 2000


class LogTail(logging.Handler):
    """Keeps the latest `KEPT` lines, on one line each and without passwords of URLs."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self._lines: deque[str] = deque(maxlen=KEPT)

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a record, as the log itself writes it."""
        try:
            self._lines.append(visible(mask_secrets(self.format(record)))[:LONGEST])
        except (TypeError, ValueError, KeyError, RecursionError):  # what a log cannot write must not stop what logs it
            self.handleError(record)

    def lines(self) -> list[str]:
        """The kept lines, oldest first."""
        return list(self._lines)


def keep_log() -> LogTail:
    """Keep what is logged from now on, in the form of the handler that is there already."""
    tail, root = LogTail(), logging.getLogger()
    if root.handlers and root.handlers[0].formatter is not None:
        tail.setFormatter(root.handlers[0].formatter)
    root.addHandler(tail)
    return tail
