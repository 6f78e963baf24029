"""Small helpers of the scenario tests."""

from __future__ import annotations

import re
import select
import signal
import socket
import sqlite3
import struct
import subprocess
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from abbe.service.domain.measured import RunRecord
from abbe.service.storage.store import Store
from tests.patience import within


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
            if b"abbe.simulators" in words and str(folder).encode() in b" ".join(words) and state != "Z":
                found.append(int(entry.name))
    return found


def interrupt(process: subprocess.Popen[str], number: signal.Signals) -> tuple[str, str]:
    """Send a signal and wait for the end; returns stdout and stderr."""
    process.send_signal(number)
    return process.communicate(timeout=within(20))


def registers(sims: Any, address: int, count: int) -> tuple[int, ...]:
    """Registers of the simulated controller, read by hand: no code of the product in between."""
    port = int(re.search(r":(\d+)\?", sims.ready["cnc"]).group(1))
    with socket.create_connection(("127.0.0.1", port), timeout=5) as s, s.makefile("rb") as f:
        s.sendall(struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, address, count))
        head = f.read(9)
        assert head[7:] == bytes([3, 2 * count]), head
        return struct.unpack(f">{count}H", f.read(2 * count))


def position_and_counters(sims: Any) -> tuple[int, ...]:
    """Registers 22..31: alarm, motion counters, position."""
    return registers(sims, 22, 10)


def axes_at_rest(sims: Any) -> bool:
    """Nothing moves and no path runs, at two looks some milliseconds of wall time (at any speed: more of machine time) apart."""
    first = registers(sims, 16, 48)
    clock = _clock_us(first)
    second = wait_for(lambda: _later(registers(sims, 16, 48), clock + 50_000), 10, "the controller's clock goes on")
    moving = [(look[4] << 16 | look[5]) & (1 << 6 | 1 << 9) for look in (first, second)]
    return moving == [0, 0] and first[10:16] == second[10:16]


def _clock_us(status: tuple[int, ...]) -> int:
    return status[0] << 48 | status[1] << 32 | status[2] << 16 | status[3]


def _later(status: tuple[int, ...], clock_us: int) -> tuple[int, ...] | None:
    return status if _clock_us(status) >= clock_us else None


def runs_of(folder: Path) -> list[RunRecord]:
    """All runs in the folder's database."""
    with Store.open(f"sqlite:///{folder / 'abbe.sqlite3'}") as store:
        return store.runs.all()


def bar_chunks(folder: Path) -> int:
    """Chunks stored so far; reads beside the writer."""
    return _count(folder, "SELECT COUNT(*) FROM chunks")


def laser_chunks(folder: Path) -> int:
    """Laser chunks of the run that is under way."""
    return _count(
        folder, "SELECT COUNT(*) FROM chunks JOIN runs ON runs.id = chunks.run_id WHERE runs.status = 'running' AND channel = 'laser'"
    )


def _count(folder: Path, query: str) -> int:
    path = folder / "abbe.sqlite3"
    if not path.exists():
        return 0
    try:
        with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as connection:
            return int(connection.execute(query).fetchone()[0])
    except sqlite3.OperationalError:  # tables not yet made, or locked for an instant
        return 0


def refused(ended: tuple[int, str, str], code: str, *words: str) -> str:
    """A command (exit code, stdout, stderr) ended with 2 and one line that holds code and words."""
    err = ended[2]
    lines = [line for line in err.strip().splitlines() if not re.match(r"^[\w-]+( [\d-]+ [\d:]+)?: ", line) or line.startswith("error")]
    assert ended[0] == 2, err
    assert len(lines) == 1, err
    assert lines[0].startswith(f"error {code}: ")
    for word in words:
        assert word in lines[0]
    return lines[0]
