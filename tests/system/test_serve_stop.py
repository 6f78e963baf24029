"""Ends: SIGTERM and Ctrl-C in every state within five seconds."""

from __future__ import annotations

import json
import signal
import socket
from contextlib import closing, suppress
from pathlib import Path

import pytest

from abbe.service.serve import notify
from abbe.service.storage.store import Store
from tests.system.serve_bench import Process, free_port, service

YEARLY = ["yearly", "0 0 1 1 *", "quick"]
ENDLESS = ["endless", "* * * * * *", "endless"]


def slots_of(folder: Path) -> set[str]:
    from sqlalchemy import create_engine, text

    engine = create_engine(f"sqlite:///{folder / 'abbe.sqlite3'}")
    with engine.connect() as connection:
        # One row is no slot: it keeps since when each time rule is in force.
        states = {str(row[0]) for row in connection.execute(text("SELECT state FROM slots WHERE state <> 'timetable'"))}
    engine.dispose()
    return states


def test_during_a_check_the_motion_is_held_and_the_slot_says_interrupted(tmp_path: Path) -> None:
    """Also while the broker is a black hole: a peer that accepts and says nothing must not hold us up."""
    with socket.create_server(("127.0.0.1", 0), backlog=8) as silent:
        url = f"mqtt://127.0.0.1:{silent.getsockname()[1]}"
        with closing(service(tmp_path, schedules=[ENDLESS], mqtt=url, port=free_port())) as running:
            silent.accept()[0].close()
            running.expect("skipped")  # the next second's slot found the first still running
            code, took_s = running.terminate()
    assert (code, took_s < 5.0) == (0, True)
    assert "held" in running.lines
    assert slots_of(tmp_path) == {"interrupted", "skipped: busy"}
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        assert store.verifications.of_machine("mill-7") == []


def told_to_systemd(folder: Path, systemd: socket.socket, port: int) -> Process:
    """Start the service as systemd does: it wants to hear of us, every 0.2 s."""
    address = str(folder / "notify")
    systemd.bind(address)
    systemd.settimeout(20)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NOTIFY_SOCKET", address)
        patch.setenv("WATCHDOG_USEC", "200000")
        return service(folder, schedules=[YEARLY], port=port)


def test_a_systemd_that_does_not_listen_holds_nothing_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    address = str(tmp_path / "notify")
    monkeypatch.setenv("NOTIFY_SOCKET", address)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(address)
        most = int(Path("/proc/sys/net/unix/max_dgram_qlen").read_text())
        told = [notify("WATCHDOG=1") for _ in range(most + 4)]
        assert told.index(False) >= most  # as many as its queue holds; each of the others comes back at once and says so
        assert not told[-1]
        assert emptied(systemd) == sum(told)
        assert notify("READY=1")
        assert systemd.recv(100) == b"READY=1"


def emptied(systemd: socket.socket) -> int:
    """Take what has come meanwhile; all of it is the watchdog's. Returns how many."""
    systemd.setblocking(False)
    count = 0
    with suppress(BlockingIOError):
        while True:
            assert systemd.recv(100) == b"WATCHDOG=1"
            count += 1
    systemd.settimeout(20)
    return count


def test_readiness_and_watchdog_reach_systemd_and_a_page_held_open_does_not_hold_us_up(tmp_path: Path) -> None:
    port = free_port()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd, closing(told_to_systemd(tmp_path, systemd, port)) as first:
        assert [systemd.recv(100) for _ in range(4)] == [b"READY=1", b"WATCHDOG=1", b"WATCHDOG=1", b"WATCHDOG=1"]
        first.expect("planned")
        emptied(systemd)  # what is full would not take the last word
        with socket.create_connection(("127.0.0.1", port)) as idle:
            idle.sendall(b"GET /api/v1/status HTTP/1.1\r\nHost: 127.0.0.1\r\n")  # and never the rest
            code, took_s = first.terminate(signal.SIGINT)
        rest = [systemd.recv(100)]
        while rest[-1] != b"STOPPING=1":
            rest.append(systemd.recv(100))
    assert (code, took_s < 5.0) == (0, True)
    assert not any("Traceback" in line for line in first.lines)
    assert json.loads(first.lines[0])["event"] == "serving"
