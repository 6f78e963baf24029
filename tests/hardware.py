"""Simulated hardware is not a program of this computer: beside other tests it does not wait for a core."""

from __future__ import annotations

import os
from contextlib import suppress

AHEAD = -10


def first(pid: int) -> None:
    """Let a simulator's process run before the tests. Only root may; elsewhere it stays as it is."""
    with suppress(PermissionError, ProcessLookupError):
        os.setpriority(os.PRIO_PROCESS, pid, AHEAD)
