"""The identity of the process that writes a run, unique even across restarts of process and computer.

The operating system reuses pids, hence the start time; start times count from boot, hence the boot id.
"""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass
from functools import cache
from pathlib import Path

UNKNOWN = "?"
"""Start time of a living process if the system does not show it; only its pid identifies such a process."""
_START_TIME_FIELD = 22 - 3
"""Field 22 of /proc/PID/stat, counted after the command name (field 2), which may itself hold blanks."""


@dataclass(frozen=True, slots=True)
class Owner:
    """The process that writes a run.

    ``host``: network name of the computer; ``start``: boot id and start time, empty if the system does not show them.
    """

    host: str
    pid: int
    start: str

    def is_gone(self) -> bool:
        """Whether this process certainly no longer runs; False if that is unknown, as on another computer."""
        if self.host != platform.node():
            return False
        now = process_start(self.pid)
        return now not in (self.start, UNKNOWN)


def process_start(pid: int) -> str:
    """Boot id and start time of a process, ``"boot_id/ticks"``.

    Empty if there is no such process; `UNKNOWN` if it lives and /proc does not show its start.
    """
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:  # no such process, no /proc, or a /proc that hides other accounts
        return _without_proc(pid)
    fields = stat.rpartition(")")[2].split()
    if fields[0] in {"Z", "X"}:  # a zombie writes nothing any more
        return ""
    return f"{_boot_id()}/{fields[_START_TIME_FIELD]}"


def this_process() -> Owner:
    """The running process."""
    pid = os.getpid()
    return Owner(platform.node(), pid, process_start(pid))


@cache
def _boot_id() -> str:
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return "?"


def _without_proc(pid: int) -> str:
    if os.name == "nt":  # os.kill would terminate the process there
        return UNKNOWN
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return ""
    except PermissionError:
        pass
    return UNKNOWN
