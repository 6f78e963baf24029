"""How much memory the page's process gets: a page that grows without end must not take the process with it that moves the machine.

Kept by the kernel for that process alone, from outside: the page cannot lift it. Should the whole service run into its own limit
(``MemoryMax`` of the unit), or the computer out of memory, the kernel takes the page first.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import structlog

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

log = structlog.get_logger("abbe.web")

FIRST_TO_GO = 900
"""As ``/proc/PID/oom_score_adj`` has it: 0 is the core's, 1000 the most there is."""


def keep_within(pid: int, memory_mb: int) -> None:
    """Bound what a process can allocate.

    Parameters
    ----------
    pid : int
        A child of ours.
    memory_mb : int
        Writable private memory that it may ask for, MiB; beyond it gets none.
    """
    with suppress(OSError):  # not everywhere there is such a file
        Path(f"/proc/{pid}/oom_score_adj").write_text(f"{FIRST_TO_GO}\n", encoding="ascii")
    if not hasattr(resource, "prlimit"):
        return
    try:
        resource.prlimit(pid, resource.RLIMIT_DATA, (memory_mb << 20, memory_mb << 20))
    except ProcessLookupError:
        pass  # gone already, as its end will tell
    except (OSError, ValueError) as error:
        log.warning("the page's memory has no limit of its own", cause=str(error))
