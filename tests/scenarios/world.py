"""Small helpers of the scenario tests."""

from __future__ import annotations

import select
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest


def wait_for(condition: Callable[[], Any], seconds: float, what: str) -> Any:
    """Poll until the condition gives something true; fail with a name when it does not."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        found = condition()
        if found:
            return found
        select.select([], [], [], 0.02)
    pytest.fail(f"not within {seconds} s: {what}")


def simulators_of(folder: Path) -> list[int]:
    """Process numbers of simulators that serve in this folder (zombies do not count)."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                words = (entry / "cmdline").read_bytes().split(b"\0")
                state = (entry / "stat").read_text().rpartition(")")[2].split()[0]
            except OSError:
                continue
            if b"simulators" in words and str(folder).encode() in b" ".join(words) and state != "Z":
                found.append(int(entry.name))
    return found


def interrupt(process: subprocess.Popen[str], number: signal.Signals) -> tuple[str, str]:
    """Send a signal and wait for the end; returns stdout and stderr."""
    process.send_signal(number)
    return process.communicate(timeout=20)
