"""Locks that the operating system gives back when a process ends, however it ends: on a segment, and on the recovery."""

from __future__ import annotations

import fcntl
import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from abbe.service.errors import CaptureFault

LOCK_NAME = "recovery.lock"
WAIT_S = 30.0
_POLL_S = 0.05


@contextmanager
def held_alone(path: Path, wait_s: float = WAIT_S) -> Iterator[bool]:
    """Hold a lock file; False when somebody else held it all the time.

    Raises
    ------
    CaptureFault
        The file cannot be made.
    """
    try:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o640)
    except OSError as error:
        raise CaptureFault(f"{path}: lock: {error.strerror}", "look at the folder of the segments and its rights") from error
    try:
        until_s = time.monotonic() + wait_s
        while not (got := _got(handle)) and time.monotonic() < until_s:
            threading.Event().wait(_POLL_S)
        yield got
    finally:
        os.close(handle)


@contextmanager
def is_free(path: Path) -> Iterator[bool]:
    """Tell whether nobody writes a segment, and keep it so meanwhile. Raises OSError."""
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        yield _got(handle)
    finally:
        os.close(handle)


def _got(handle: int) -> bool:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
