"""The end of a process that does not end by itself in time."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable

import structlog

log = structlog.get_logger("abbe.serve")

WORDS_S = 0.25
"""Longest time to read the push journal before a forced end, s."""
LastWords = Callable[[], str]
"""Which push is open, as a sentence; empty: none."""


def cut_off_now(words: list[LastWords]) -> None:
    """End the process. The axes were stopped first, and the journal of a push is always ahead of what it permits: nothing is lost."""
    told: list[str] = []
    for one in words:  # in a thread of its own: a database that hangs must not hold up the end
        reading = threading.Thread(target=lambda say=one: told.append(say()), daemon=True)
        reading.start()
        reading.join(WORDS_S)
    log.error("something did not stop in time; ending the process", open_push=told[0] if told else "the journal could not be read")
    leave_now(1)


def leave_now(code: int) -> None:
    """End the process at once, its output written."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
