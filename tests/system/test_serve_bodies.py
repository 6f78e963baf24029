"""A body of a gigabyte at every route that takes one, by everybody: the page refuses it as it begins, and its memory does not grow.

A page that grows all the same has a limit of its own, which the core is not under.
"""

from __future__ import annotations

import resource
import select
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import httpx
import pytest

from abbe.service.config_schema import Web
from abbe.service.core.web_process import OOM_SCORE_ADJ
from abbe.service.domain.people import Role
from tests.system.test_serve_processes import YEARLY, Running, bench, ended

GIGABYTE, PIECE_B, GROWTH_KB = 1 << 30, 1 << 18, 8 * 1024
BY_FORM = ("/login", "/logout", "/proposal/approve", "/proposal/reject", "/alarm/acknowledge", "/alarm/shelve",
           "/settings/password", "/settings/pin",
           *(f"/users/{form}" for form in ("add", "role", "password", "disable", "enable")),
           *(f"/administration/{form}" for form in ("laboratory", "limits", "certificates", "schedule", "read")))  # fmt: skip
"""Not in the OpenAPI document; that these are all is asked in tests/service/web/test_bodies.py."""
PATIENCE_S = 30.0


def routes(made: Running) -> list[str]:
    """Every route that is asked by POST, with numbers in its path."""
    paths = made.http.get("/api/v1/openapi.json", headers=made.who["viewer"]).json()["paths"]
    found = [path for path, methods in paths.items() if "post" in methods]
    assert not any(set(methods) & {"put", "patch", "delete"} for methods in paths.values())
    return [path.replace("{job}", "0" * 12).replace("{prompt}", "1").replace("{number}", "1") for path in found] + [*BY_FORM]


def memory_kb(pid: int, name: str) -> int:
    status = Path(f"/proc/{pid}/status").read_text()
    return int(next(line for line in status.splitlines() if line.startswith(f"{name}:")).split()[1])


def head(path: str, how: str, who: dict[str, str]) -> bytes:
    lines = [f"POST {path} HTTP/1.1", "Host: 127.0.0.1", "Content-Type: application/json", how, *(f"{k}: {v}" for k, v in who.items())]
    return ("\r\n".join(lines) + "\r\n\r\n").encode()


def pour(port: int, path: str, who: dict[str, str], *, chunked: bool) -> tuple[int, bytes, int]:
    """Send until there is an answer; its status, the answer, and how many bytes were taken."""
    how = "Transfer-Encoding: chunked" if chunked else f"Content-Length: {GIGABYTE}"
    frame = b"%x\r\n" % PIECE_B + b"x" * PIECE_B + b"\r\n" if chunked else b"x" * PIECE_B
    sent, rest, until_s = 0, b"", time.monotonic() + PATIENCE_S
    with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S) as connection:
        connection.sendall(head(path, how, who))
        connection.setblocking(False)
        while sent < GIGABYTE:
            assert time.monotonic() < until_s, f"{path}: no answer; {sent} bytes were taken"
            readable, writable, _ = select.select([connection], [connection], [], 1.0)
            if readable:
                answer = connection.recv(1 << 16)
                return int(answer.split()[1]), answer, sent
            if writable:
                rest = rest or frame
                taken = connection.send(rest)
                rest, sent = rest[taken:], sent + taken
    raise AssertionError(f"{path}: the whole gigabyte was taken")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """One service for both tests: after each it answers."""
    with bench(tmp_path_factory.mktemp("bodies"), YEARLY) as running:
        yield running


def limit_b(pid: int) -> int:
    return resource.prlimit(pid, resource.RLIMIT_DATA)[0]


def last_to_go(pid: int) -> int:
    return int(Path(f"/proc/{pid}/oom_score_adj").read_text())


def test_a_page_without_memory_is_replaced_and_the_core_stays(made: Running) -> None:
    """First in this file: a page that has answered much finds room in what it already has."""
    page, core = made.web, made.process.pid
    assert (limit_b(page), limit_b(core)) == (Web().memory_mb << 20, resource.RLIM_INFINITY)
    assert (last_to_go(page), last_to_go(core)) == (OOM_SCORE_ADJ, 0)
    used_b = memory_kb(page, "VmData") << 10
    resource.prlimit(page, resource.RLIMIT_DATA, (used_b, Web().memory_mb << 20))  # nothing more: the limit has been reached
    until_s = time.monotonic() + PATIENCE_S
    while not ended(page, 0.1):
        assert time.monotonic() < until_s, "it goes on without memory"
        with suppress(httpx.TransportError):
            made.http.get("/api/v1/openapi.json", headers=made.who["viewer"])
    made.process.expect("starting it again")
    assert made.http.get("/readyz").status_code == 200
    assert (made.process.pid, limit_b(made.web)) == (core, Web().memory_mb << 20)


@pytest.mark.timeout(300)
def test_a_gigabyte_at_every_route_costs_no_memory(made: Running) -> None:
    everybody = [*((str(role), made.who[str(role)]) for role in Role), ("anonymous", {})]
    paths, page, began_s = routes(made), made.web, time.monotonic()
    for path in paths:  # what a first answer costs is not counted
        made.http.post(path, content=b"x" * 100, headers=made.who["admin"])
    Path(f"/proc/{page}/clear_refs").write_text("5")  # the highest from here on
    before_kb, most = memory_kb(page, "VmRSS"), 0
    for path in paths:
        threading.Event().wait(len(everybody) * 2 / 50.0)  # an address has 50 requests a second
        for name, who in everybody:
            for chunked in (False, True):
                status, answer, sent = pour(made.port, path, who, chunked=chunked)
                wanted = 401 if name == "anonymous" and path != "/login" else 413
                assert status == wanted, (path, name, chunked, answer)
                assert b"application/problem+json" in answer
                most = max(most, sent)
    grown_kb = memory_kb(page, "VmHWM") - before_kb
    assert made.web == page
    assert made.http.get("/healthz").status_code == 200
    print(  # noqa: T201 - figures for whoever runs it by hand
        f"{len(paths)} routes, {len(everybody)} roles: {grown_kb} kB more, at most {most} bytes taken, {time.monotonic() - began_s:.1f} s"
    )
    assert grown_kb < GROWTH_KB
