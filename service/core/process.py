"""The core's own process: notifications to systemd, and its forced end if it does not end in time."""

from __future__ import annotations

import os
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import suppress

import structlog

log = structlog.get_logger("abbe.serve")

JOURNAL_S = 0.25
"""Longest time to read the push journal before a forced end, s."""
OpenPushReader = Callable[[], str]
"""Return the open push as a sentence; empty: none."""


def cut_off_now(readers: list[OpenPushReader]) -> None:
    """End the process. The axes have stopped already, and the push journal is written before each step that it permits: nothing is lost."""
    texts: list[str] = []
    for one in readers:  # in a thread of its own: a database that hangs must not delay the end
        reading = threading.Thread(target=lambda read=one: texts.append(read()), daemon=True)
        reading.start()
        reading.join(JOURNAL_S)
    log.error("stop timeout; ending the process", open_push=texts[0] if texts else "the journal could not be read")
    leave_now(1)


def leave_now(code: int) -> None:
    """End the process at once, after flushing its output."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def notify(state: str) -> None:
    """Notify systemd (``sd_notify``). Does nothing without systemd."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    if address.startswith("@"):
        address = "\0" + address[1:]
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel:
        channel.connect(address)
        channel.send(state.encode())
