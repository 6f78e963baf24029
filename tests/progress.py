"""A complete run of the tests as a person sees it: one line of progress, each failure once, and the slow files first.

Loaded by ``make test`` without ARGS (``-p tests.progress``). `SECONDS` holds what each slow file took, so that no worker begins a long
file when the others have ended, and the line can say how long it still takes. ``--write-seconds`` writes it anew.
"""

from __future__ import annotations

import os
import sys
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import TextIO

import pytest

SECONDS = Path(__file__).with_name("seconds.txt")
SLOW_S, QUICK_S = 2.0, 0.5
"""A file that takes longer is written into `SECONDS`; what a file takes that is not there."""
WIRES = (
    "tests/faults", "tests/push", "tests/linuxcnc", "tests/system", "tests/scenarios", "tests/drivers", "tests/service/capture",
    "tests/service/core", "tests/service/plant", "tests/service/web",
)  # fmt: skip
"""What talks to devices and browsers: some of its promises are tenths of a second, so what only computes gives way to it."""
GIVES_WAY = 10
REDRAWN_S, REPEATED_S = 0.5, 60.0
"""How often the line changes on a terminal, and how often it is printed anew elsewhere."""


def read_seconds(path: Path = SECONDS) -> dict[str, float]:
    """Return how long each slow file took, in seconds, by its path from the root."""
    rows = (line.split() for line in path.read_text().splitlines())
    return {name: float(seconds) for seconds, name in rows}


def file_of(nodeid: str) -> str:
    """Return the file of a test."""
    return nodeid.partition("::")[0]


def in_turn(files: Iterable[str], seconds: dict[str, float]) -> list[str]:
    """Return the files in the order in which they begin: the slow ones first, what talks to devices and what only computes in turn.

    Four browsers and simulators at once keep each other waiting for tenths of a second; beside what gives way they do not.
    """
    slow_first = sorted(files, key=lambda name: -seconds.get(name, QUICK_S))
    queues = [[name for name in slow_first if name.startswith(WIRES) == wires] for wires in (True, False)]
    whole = [sum(seconds.get(name, QUICK_S) for name in queue) for queue in queues]
    begun, out = [0.0, 0.0], []
    while any(queues):
        k = min((k for k in (0, 1) if queues[k]), key=lambda k: begun[k] / whole[k])
        out.append(queues[k].pop(0))
        begun[k] += seconds.get(out[-1], QUICK_S)
    return out


class Progress:
    """Counts what has ended, and says so in one line."""

    def __init__(self, out: TextIO, seconds: dict[str, float], clock: float) -> None:
        self.out, self.seconds, self.start = out, seconds, clock
        self.weight: dict[str, float] = {}
        self.took: Counter[str] = Counter()
        self.whole = 0.0
        self.ended = self.failed = 0
        self.said = clock

    def expect(self, nodeids: list[str]) -> None:
        """Take in which tests there are."""
        if self.ended:  # a worker that was started anew
            return
        counts = Counter(map(file_of, nodeids))
        self.weight = {one: self.seconds.get(file_of(one), QUICK_S) / counts[file_of(one)] for one in nodeids}
        self.whole = sum(self.weight.values())

    def line(self, now: float) -> str:
        """Return the line of progress."""
        elapsed = now - self.start
        share = 1.0 - sum(self.weight.values()) / self.whole if self.whole else 1.0
        eta = f", about {_minutes(elapsed * (1.0 - share) / share)} left" if 0.02 < share < 0.999 else ""
        failed = f", {self.failed} FAILED" if self.failed else ""
        return f"{self.ended} of {self.ended + len(self.weight)} tests{failed}, {_minutes(elapsed)}{eta}"

    def end(self, nodeid: str, *, failed: bool) -> None:
        """Count a test that has ended; a failed one is named at once."""
        self.ended += nodeid in self.weight
        self.weight.pop(nodeid, None)
        if failed:
            self.failed += 1
            self._write(f"FAILED {nodeid}\n")

    def show(self, now: float) -> None:
        """Print the line where it is time to."""
        if now - self.said >= (REDRAWN_S if self.out.isatty() else REPEATED_S):
            self.said = now
            self._write(self.line(now) + ("" if self.out.isatty() else "\n"))

    def clear(self) -> None:
        """Take the line away: what follows is pytest's own."""
        if self.out.isatty():
            self._write("")

    def _write(self, text: str) -> None:
        self.out.write(("\r\x1b[K" if self.out.isatty() else "") + text)
        self.out.flush()


def _minutes(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds >= 90 else f"{seconds:.0f} s"


# --- pytest's hooks --------------------------------------------------------------------------------------------------------------------


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--write-seconds", action="store_true", help=f"write {SECONDS.name} anew from this run")


def pytest_configure(config: pytest.Config) -> None:
    if not hasattr(config, "workerinput"):  # a worker of xdist says nothing itself
        config.pluginmanager.register(Display(config.getoption("--write-seconds")))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    turn = {name: k for k, name in enumerate(in_turn({file_of(item.nodeid): None for item in items}, read_seconds()))}
    items.sort(key=lambda item: turn[file_of(item.nodeid)])  # stable: a file's tests keep their order


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Let a test that only computes give way. Only root may take that back for the next one, so for others all are alike."""
    if hasattr(item.config, "workerinput") and os.geteuid() == 0:
        os.setpriority(os.PRIO_PROCESS, 0, 0 if item.nodeid.startswith(WIRES) else GIVES_WAY)


class Display:
    """Shows the progress of the process that a person looks at."""

    def __init__(self, write_seconds: bool) -> None:
        self.progress = Progress(sys.stdout, read_seconds(), time.monotonic())
        self.write_seconds = write_seconds

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionstart(self, session: pytest.Session) -> None:
        workers = session.config.pluginmanager.getplugin("terminaldistreporter")
        for name in ("setstatus", "ensure_show_status") if workers is not None else ():
            setattr(workers, name, lambda *_, **__: None)  # what xdist says of its workers, and called as an object, not as a plug-in

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        self.progress.expect([item.nodeid for item in session.items])

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, ids: list[str]) -> None:
        self.progress.expect(ids)

    @pytest.hookimpl(tryfirst=True)
    def pytest_report_teststatus(self, report: pytest.TestReport) -> tuple[str, str, str] | None:
        """No letter for each of thousands of tests; the counts at the end stay."""
        expected_to_fail = "x" if hasattr(report, "wasxfail") else ""
        if report.skipped:
            return expected_to_fail + ("failed" if expected_to_fail else "skipped"), "", ""
        if report.when == "call":
            return expected_to_fail + report.outcome, "", ""
        return ("error" if report.failed else ""), "", ""

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.progress.took[file_of(report.nodeid)] += report.duration
        if report.when == "call" or not report.passed:
            self.progress.end(report.nodeid, failed=report.failed)
        self.progress.show(time.monotonic())

    def pytest_sessionfinish(self) -> None:
        self.progress.clear()
        if self.write_seconds:
            slow = sorted(((s, one) for one, s in self.progress.took.items() if s >= SLOW_S), reverse=True)
            SECONDS.write_text("".join(f"{s:.0f} {one}\n" for s, one in slow))
