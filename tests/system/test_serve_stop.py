"""Ends: SIGTERM in every state within five seconds, a taken port in one line."""

from __future__ import annotations

import json
import os
import signal
import socket
from contextlib import closing
from pathlib import Path

from abbe.service.storage.store import Store
from tests.system.serve_bench import Process, free_port, service

YEARLY = ["yearly", "0 0 1 1 *", "quick"]
ENDLESS = ["endless", "* * * * * *", "endless"]


def slots_of(folder: Path) -> set[str]:
    from sqlalchemy import create_engine, text

    engine = create_engine(f"sqlite:///{folder / 'abbe.sqlite3'}")
    with engine.connect() as connection:
        states = {str(row[0]) for row in connection.execute(text("SELECT state FROM slots"))}
    engine.dispose()
    return states


def test_during_a_check_the_motion_is_held_and_the_slot_says_interrupted(tmp_path: Path) -> None:
    with closing(service(tmp_path, schedules=[ENDLESS], port=free_port())) as running:
        running.expect("skipped")  # the next second's slot found the first still running
        code, took_s = running.terminate()
    assert (code, took_s < 5.0) == (0, True)
    assert "held" in running.lines
    assert slots_of(tmp_path) == {"interrupted", "skipped: busy"}
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        assert store.verifications.of_machine("mill-7") == []


def test_while_the_broker_is_a_black_hole(tmp_path: Path) -> None:
    """A peer that accepts and says nothing must not hold us up."""
    with socket.create_server(("127.0.0.1", 0), backlog=8) as silent:
        url = f"mqtt://127.0.0.1:{silent.getsockname()[1]}"
        with closing(service(tmp_path, schedules=[ENDLESS], mqtt=url, port=free_port())) as running:
            silent.accept()[0].close()
            running.expect("skipped")
            code, took_s = running.terminate()
    assert (code, took_s < 5.0) == (0, True)


def test_a_page_that_is_held_open_does_not_hold_us_up(tmp_path: Path) -> None:
    port = free_port()
    with closing(service(tmp_path, schedules=[YEARLY], port=port)) as running:
        running.expect("planned")
        with socket.create_connection(("127.0.0.1", port)) as idle:
            idle.sendall(b"GET /api/v1/status HTTP/1.1\r\nHost: 127.0.0.1\r\n")  # and never the rest
            code, took_s = running.terminate()
    assert (code, took_s < 5.0) == (0, True)
    assert not any("Traceback" in line for line in running.lines)


def test_readiness_and_watchdog_reach_systemd(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        address = str(tmp_path / "notify")
        systemd.bind(address)
        systemd.settimeout(20)
        os.environ.update(NOTIFY_SOCKET=address, WATCHDOG_USEC="200000")
        try:
            running = service(tmp_path, schedules=[YEARLY], port=free_port())
        finally:
            del os.environ["NOTIFY_SOCKET"], os.environ["WATCHDOG_USEC"]
        with closing(running):
            assert [systemd.recv(100) for _ in range(4)] == [b"READY=1", b"WATCHDOG=1", b"WATCHDOG=1", b"WATCHDOG=1"]
            running.terminate()
            rest = [systemd.recv(100)]
            while rest[-1] != b"STOPPING=1":
                rest.append(systemd.recv(100))


def test_two_services_on_one_port_and_ctrl_c_ends_the_first(tmp_path: Path) -> None:
    port = free_port()
    (tmp_path / "second").mkdir()
    with closing(service(tmp_path, schedules=[YEARLY], port=port)) as first:
        first.expect("planned")
        second: Process = service(tmp_path / "second", schedules=[YEARLY], port=port)
        second.expect("ConfigError")
        assert second.wait() != 0
        code, took_s = first.terminate(signal.SIGINT)
    assert (code, took_s < 5.0) == (0, True)
    assert not any("Traceback" in line for line in first.lines)
    assert json.loads(first.lines[0])["event"] == "serving"
