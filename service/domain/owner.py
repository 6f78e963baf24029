"""The process that writes a run, named so that no other is mistaken for it, not even after a restart of process or computer.

The operating system reuses pids, hence the start time; start times count from boot, hence the boot id.
"""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass
from functools import cache
from pathlib import Path

UNKNOWN = "?"
"""Start time of a living process where the system does not show it. A process that has this start time is known by its pid alone."""
_START_TIME_FIELD = 22 - 3
"""Field 22 of /proc/PID/stat, counted after the command name (field 2), which may itself hold blanks."""


@dataclass(frozen=True, slots=True)
class Owner:
    """The process that writes a run.

    Parameters
    ----------
    host : str
        Network name of the computer.
    pid : int
        Process id.
    start : str
        Boot id and start time of the process; empty where the system does not show them.
    """

    host: str
    pid: int
    start: str

    def is_gone(self) -> bool:
        """Whether this process certainly no longer runs; False also when that cannot be known: on another computer."""
        if self.host != platform.node():
            return False
        now = process_start(self.pid)
        return now not in (self.start, UNKNOWN)


def process_start(pid: int) -> str:
    """Boot id and start time of a process, ``"boot_id/ticks"``.

    Empty if there is no such process; `UNKNOWN` if it lives and /proc does not show since when.
    """
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:  # none such, no /proc, or one that hides the processes of other accounts
        return _without_proc(pid)
    fields = stat.rpartition(")")[2].split()
    if fields[0] in {"Z", "X"}:  # killed and not yet collected by its parent: it writes nothing any more
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
