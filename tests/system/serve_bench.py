"""Real processes for the service's system tests. Waiting is always for a line that a process writes, never for time to pass."""

from __future__ import annotations

import json
import os
import queue
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests import hardware

HERE = Path(__file__).parent
PATIENCE_S = 75.0


def require(name: str, *places: str) -> str:
    """Return the path of a program; skip the test without it, or fail if ABBE_TEST_REQUIRE demands it."""
    found = next((path for place in (name, *places) if (path := shutil.which(place))), None)
    if found is None:
        if name in os.environ.get("ABBE_TEST_REQUIRE", "").split(","):
            pytest.fail(f"{name} is required by ABBE_TEST_REQUIRE and not installed")
        pytest.skip(f"{name} is not installed (apt-get install -y {name})")
    return found


def chromium_program() -> str:
    """Return the path of Chromium: of its headless shell, the same engine that starts in a third of the time, or of the whole browser."""
    return shutil.which("chromium-headless-shell") or require("chromium")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Process:
    """A child process whose lines can be waited for."""

    def __init__(self, *command: str | Path, env: dict[str, str] | None = None) -> None:
        self.lines: list[str] = []
        self._queue: queue.Queue[str | None] = queue.Queue()
        self._child = subprocess.Popen(
            [str(part) for part in command],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            bufsize=1,
            env={**os.environ, "PYTHONUNBUFFERED": "1", **(env or {})},
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        return self._child.pid

    def _read(self) -> None:
        assert self._child.stdout is not None
        for line in self._child.stdout:
            self._queue.put(line.rstrip("\n"))
        self._queue.put(None)

    def expect(self, text: str, patience_s: float = PATIENCE_S) -> str:
        """Return the next line that contains ``text``."""
        deadline_s = time.monotonic() + patience_s
        while True:
            try:
                line = self._queue.get(timeout=max(deadline_s - time.monotonic(), 0.001))
            except queue.Empty:
                raise AssertionError(f"no line with {text!r} within {patience_s} s; there were:\n" + "\n".join(self.lines[-40:])) from None
            if line is None:
                self._queue.put(None)
                raise AssertionError(f"the process ended without a line with {text!r}; there were:\n" + "\n".join(self.lines[-40:]))
            self.lines.append(line)
            if text in line:
                return line

    def kill(self) -> None:
        self._child.kill()
        self._end()

    def terminate(self, number: int = signal.SIGTERM) -> tuple[int, float]:
        """Send a signal; return exit code and seconds until the end."""
        started_s = time.monotonic()
        self._child.send_signal(number)
        code = self._child.wait(timeout=PATIENCE_S)
        took_s = time.monotonic() - started_s
        self._end()
        return code, took_s

    def wait(self) -> int:
        code = self._child.wait(timeout=PATIENCE_S)
        self._end()
        return code

    def _end(self) -> None:
        self._child.wait(timeout=PATIENCE_S)
        self._reader.join(timeout=PATIENCE_S)
        assert self._child.stdout is not None
        self._child.stdout.close()
        while not self._queue.empty():
            line = self._queue.get()
            if line is not None:
                self.lines.append(line)
        self._queue.put(None)

    def close(self) -> None:
        if self._child.poll() is None:
            self.kill()


class Broker:
    """A real Mosquitto that keeps its subscribers' sessions on disk, on a port that stays the same."""

    def __init__(self, folder: Path, *tls: str) -> None:
        """``tls``: lines of a second, encrypted listener."""
        self.port, self.tls_port = free_port(), free_port()
        self._program = require("mosquitto", "/usr/sbin/mosquitto")
        self._config = folder / "mosquitto.conf"
        data = folder / "broker"
        data.mkdir()
        self._kept = data / "mosquitto.db"
        self._config.write_text(
            f"listener {self.port} 127.0.0.1\nallow_anonymous true\nuser root\n"
            f"persistence true\npersistence_location {data}/\nautosave_on_changes true\nautosave_interval 1\n"
            + "\n".join([f"listener {self.tls_port} 127.0.0.1", *tls, ""] if tls else [])
        )
        self.process = self.start()

    @property
    def url(self) -> str:
        return f"mqtt://127.0.0.1:{self.port}"

    def start(self) -> Process:
        self.process = Process(self._program, "-v", "-c", self._config)
        self.process.expect("running")
        return self.process

    def subscriber(self, name: str = "receiver") -> Process:
        """Return a real client with a session of its own: what is published while it reconnects is kept for it."""
        program = require("mosquitto_sub")
        at = ("-h", "127.0.0.1", "-p", str(self.port))
        receiver = Process(program, *at, "-q", "1", "-c", "-i", name, "-t", "plant/#", "-F", "MSG %t %p")
        self.process.expect(f"Sending SUBACK to {name}")
        # The answer comes before the file: killed between the two, the broker would not know this session when it comes back, and what is
        # published before the client subscribes anew would be nobody's.
        self.wait_for_file(lambda kept: b"plant/#" in kept and kept.count(name.encode()) >= 2)
        return receiver

    def wait_for_file(self, wanted: Callable[[bytes], bool]) -> None:
        """Wait until what the broker would read after being killed is as ``wanted`` (it writes the file anew after each change)."""
        deadline_s = time.monotonic() + PATIENCE_S
        while not (self._kept.exists() and wanted(self._kept.read_bytes())):
            assert time.monotonic() < deadline_s, f"the broker did not keep what was waited for within {PATIENCE_S} s"
            threading.Event().wait(0.01)


def service(folder: Path, **config: Any) -> Process:
    """Start the service with the check that needs no devices."""
    path = folder / "service.json"
    path.write_text(json.dumps({"store": f"sqlite:///{folder / 'abbe.sqlite3'}", **config}))
    return Process(sys.executable, HERE / "serve_check.py", path)


def payload(line: str) -> dict[str, Any]:
    """Return the JSON of a subscriber's line."""
    loaded: dict[str, Any] = json.loads(line.split(" ", 2)[2])
    return loaded


class Machine:
    """The simulators as a process, and a machine file that names their ports."""

    def __init__(self, folder: Path, speed: float, *sections: str) -> None:
        self.process = Process(sys.executable, "-m", "abbe.simulators", "--speed", str(speed), "--ballbar", "tcp", "--link-dir", folder)
        ready = json.loads(self.process.expect('"ready"'))
        hardware.first(self.process.pid)
        machine = ready["machine"]
        lines = ['name = "mill-7"', f"chain = {json.dumps(machine['chain'])}", f"tool_mm = {json.dumps(machine['tool_mm'])}"]
        for table in ("stroke_mm", "pivots_mm"):
            lines += [f"[{table}]", *(f"{axis} = {json.dumps(value)}" for axis, value in machine[table].items())]
        lines += ["[devices]", *(f"{role} = {json.dumps(ready[role])}" for role in ("cnc", "ballbar", "laser", "fixture"))]
        self.file = folder / "machine.toml"
        self.file.write_text("\n".join([*lines, *sections]) + "\n")


def abbe(*arguments: str | Path) -> Process:
    """Start the command ``abbe``."""
    return Process(sys.executable, "-c", "from abbe.service.cli import main; main()", *arguments)
