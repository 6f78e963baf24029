"""A simulated machine as child processes, and the command line as a user types it."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from abbe.service.cli import run
from tests import hardware
from tests.patience import within

ABBE = [sys.executable, "-c", "from abbe.service.cli import main; main()"]


@dataclass
class Sims:
    """A running simulated world and the machine file that points to it."""

    ready: dict[str, Any]
    process: subprocess.Popen[str]
    machine_file: Path

    def ask(self, op: str, **words: Any) -> dict[str, Any]:
        """Speak to the fixture's port: mounting, and for tests faults and the ledger."""
        host, port = self.ready["fixture"].removeprefix("fixture+tcp://").split(":")
        with socket.create_connection((host, int(port)), timeout=5) as s, s.makefile("rw") as f:
            f.write(json.dumps({"id": 1, "op": op, **words}) + "\n")
            f.flush()
            answer = json.loads(f.readline())
        assert answer["ok"], answer
        return answer


def machine_toml(ready: dict[str, Any], extra: str = "") -> str:
    m = ready["machine"]
    lines = ['name = "sim"', f'chain = "{m["chain"]}"', f"tool_mm = {json.dumps(m['tool_mm'])}", "[stroke_mm]"]
    lines += [f"{a} = {json.dumps(v)}" for a, v in m["stroke_mm"].items()]
    lines += ["[pivots_mm]"] + [f"{a} = {json.dumps(v)}" for a, v in m["pivots_mm"].items()]
    lines += ["[calibration]", "ballbar = 2099-12-31", "laser = 2099-12-31"]
    lines += ["[devices]"] + [f'{k} = "{ready[k]}"' for k in ("cnc", "ballbar", "laser", "fixture")]
    return "\n".join(lines) + "\n" + extra + "\n"


SIMULATORS = (sys.executable, "-m", "abbe.simulators")


@contextmanager
def simulated(folder: Path, *args: str, extra: str = "", program: tuple[str, ...] = SIMULATORS) -> Iterator[Sims]:
    """Simulators with their machine file in a folder; they end with the block."""
    words = [*program, "--watch-stdin", "--link-dir", str(folder), *args]
    process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdin is not None
    assert process.stdout is not None
    hardware.first(process.pid)
    try:
        ready = json.loads(process.stdout.readline())
        path = folder / "machine.toml"
        path.write_text(machine_toml(ready, extra))
        yield Sims(ready, process, path)
    finally:
        process.stdin.close()
        process.wait(timeout=within(10))
        process.stdout.close()


@pytest.fixture
def start_sims(tmp_path: Path) -> Iterator[Callable[..., Sims]]:
    """Start simulators; ended after the test."""
    with ExitStack() as running:

        def start(*args: str, extra: str = "") -> Sims:
            return running.enter_context(simulated(tmp_path, *args, extra=extra))

        yield start


@pytest.fixture
def command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Run `abbe ...` in this process, in the test's folder: exit code, stdout, stderr. A process of its own takes seconds to start."""
    monkeypatch.chdir(tmp_path)

    def call(*words: object) -> tuple[int, str, str]:
        capsys.readouterr()
        code = run([str(word) for word in words])
        return code, *capsys.readouterr()

    return call


@pytest.fixture
def abbe(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start `abbe ...` in the test's folder; killed after the test if it still runs."""
    running: list[subprocess.Popen[str]] = []

    def start(*args: str, cwd: Path = tmp_path) -> subprocess.Popen[str]:
        words = [*ABBE, *args]
        running.append(
            subprocess.Popen(words, cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, stdin=subprocess.DEVNULL)
        )
        return running[-1]

    yield start
    for process in running:
        if process.poll() is None:
            process.kill()
        process.communicate()
