"""Who writes a run: a process, named so that nobody else is taken for it, also after a restart of process or computer.

A pid alone is reused by the operating system, hence the start time, and start times count from boot, hence the boot id.
"""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass
from functools import cache
from pathlib import Path

UNKNOWN = "?"
"""Since when a process runs that lives, where nobody can tell. Where a process says it of itself, pids must do."""
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
        Boot id and start time of the process; empty where the system does not tell.
    """

    host: str
    pid: int
    start: str

    def is_gone(self) -> bool:
        """Tell whether this process certainly does not run any more.

        Returns
        -------
        bool
            False also when it cannot be known, i.e. for processes of another computer.
        """
        if self.host != platform.node():
            return False
        now = process_start(self.pid)
        return now not in (self.start, UNKNOWN)


def process_start(pid: int) -> str:
    """Read boot id and start time of a process.

    Parameters
    ----------
    pid : int
        Process id.

    Returns
    -------
    str
        ``"boot_id/ticks"``; empty if there is no such process; `UNKNOWN` if it lives and /proc does not tell since when.
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
    """Name the running process.

    Returns
    -------
    Owner
        Host, pid and start.
    """
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
