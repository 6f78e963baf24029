"""Two processes: what a killed or frozen one does to the other, and jobs over HTTP by everybody, with a real service each time."""

from __future__ import annotations

import json
import os
import select
import signal
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from abbe.service.audit.book import AuditBook
from abbe.service.capture.ledger import ledger_of, streams_from_end_doc
from abbe.service.clock import SystemClock
from abbe.service.domain.people import ALLOWED, Permission, Role
from abbe.service.storage.store import Store
from abbe.service.users.people import UserAccounts
from tests.system.serve_bench import Machine, Process, abbe, free_port, service
from tests.system.test_serve_stop import slots_of

PHRASE = "correct horse battery staple"
YEARLY, ENDLESS = ["yearly", "0 0 1 1 *", "quick"], ["rare", "0 0 2 1 *", "endless"]


def url_of(folder: Path) -> str:
    return f"sqlite:///{folder / 'abbe.sqlite3'}"


def tokens(folder: Path) -> dict[str, dict[str, str]]:
    """A user of each role, and the header with his token."""
    made = {}
    with Store.open(url_of(folder)) as store:
        people = UserAccounts(store, SystemClock())
        for role in Role:
            people.add(f"a-{role}", role, PHRASE)
            scopes = sorted(ALLOWED[role])
            made[str(role)] = {"Authorization": f"Bearer {people.add_token(f'a-{role}', 'test', scopes, 5.0)}"}
    return made


@dataclass
class Running:
    """A service with its page."""

    process: Process
    http: httpx.Client
    who: dict[str, dict[str, str]]
    port: int

    def start(self, recipe: str, who: str = "operator", **headers: str) -> httpx.Response:
        return self.http.post("/api/v1/jobs", json={"recipe": recipe}, headers={**self.who[who], **headers})

    def job(self, number: str) -> dict[str, Any]:
        found: dict[str, Any] = self.http.get(f"/api/v1/jobs/{number}", headers=self.who["viewer"]).json()
        return found

    def until(self, number: str, *states: str) -> dict[str, Any]:
        """Look again until the job is at one of these states."""
        with connect(f"ws://127.0.0.1:{self.port}/api/v1/live", additional_headers=self.who["viewer"]) as live:
            while (job := self.job(number))["state"] not in states:
                live.recv(timeout=30)  # the next event: at most a second from now
        return job

    @property
    def web(self) -> int:
        """Process id of the page."""
        pid = self.process.pid
        (child,) = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        return int(child)


@contextmanager
def running(folder: Path, process: Process, port: int, who: dict[str, dict[str, str]]) -> Iterator[Running]:
    with closing(process), httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=30) as http:
        process.expect('"page up"')
        yield Running(process, http, who, port)


@contextmanager
def bench(folder: Path, *schedules: list[str]) -> Iterator[Running]:
    who, port = tokens(folder), free_port()
    with running(folder, service(folder, schedules=[*schedules], port=port), port, who) as made:
        yield made


def listen(live: ClientConnection, timeout_s: float) -> None:
    """Hear one event after the other, for ever: until nothing comes, or the other side ends it."""
    while True:
        live.recv(timeout=timeout_s)


def ended(pid: int, within_s: float) -> bool:
    """Wait until a process that is not our child has ended."""
    try:
        handle = os.pidfd_open(pid)
    except ProcessLookupError:
        return True
    try:
        return bool(select.select([handle], [], [], within_s)[0])
    finally:
        os.close(handle)


@pytest.mark.scenario
def test_the_page_is_killed_during_a_check_and_no_sample_is_missing(tmp_path: Path) -> None:
    port, who = free_port(), tokens(tmp_path)
    recipe = "quick-check at 50 Hz"
    timetable = ["[[schedule]]", 'name = "yearly"', 'cron = "0 0 1 1 *"', f'recipe = "{recipe}"']
    machine = Machine(tmp_path, 100.0, "[web]", f"port = {port}", *timetable)
    with closing(machine.process), running(tmp_path, abbe("serve", "-m", machine.file), port, who) as abbe_serve:
        number = abbe_serve.start(recipe).json()["id"]
        with connect(f"ws://127.0.0.1:{port}/api/v1/live", additional_headers=who["viewer"]) as live:
            while not ((job := json.loads(live.recv(timeout=60))["job"]) and job["done"] > 0):
                pass
            assert (job["id"], job["state"], job["recipe"]) == (number, "running", recipe)
            killed, killed_s = abbe_serve.web, time.monotonic()
            os.kill(killed, signal.SIGKILL)
            with pytest.raises(ConnectionClosed):
                listen(live, 30)
        ready = httpx.get(f"http://127.0.0.1:{port}/readyz", timeout=30)  # waits in the queue of the socket, which the core holds
        assert ready.status_code == 200
        back_s = time.monotonic() - killed_s
        assert abbe_serve.web != killed
        assert back_s < 10.0, "promised are 3 s of a computer that has nothing else to do"
        abbe_serve.http.close()  # its connection was to the one that is gone
        abbe_serve.http = httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=30)
        assert "abbe_web_restarts_total 1.0" in abbe_serve.http.get("/metrics", headers=who["viewer"]).text
        done = abbe_serve.until(number, "done: pass", "done: fail", "done: cannot tell")
        assert done["who"] == "token:a-operator/test"
        abbe_serve.http.close()
        code, took_s = abbe_serve.process.terminate()
        assert (code, took_s < 5.0) == (0, True)
    with Store.open(url_of(tmp_path)) as store:
        (check,) = store.verifications.of_machine("mill-7")
        assert (check.id, check.doc["cause"], check.doc["schedule"]) == (done["verification"], None, "by hand")
        runs = store.runs.all()
        assert len(runs) == len(check.doc["runs"]) > 2
        assert {run.status for run in runs} == {"complete"}
        ledgers = [ledger_of(store.chunks.of_run(run.id), streams_from_end_doc(run.end_doc)) for run in runs]
        assert [(ledger.unaccounted(), ledger.duplicates()) for ledger in ledgers] == [([], 0)] * len(runs)
        assert sum(ledger.stored for ledger in ledgers) > 1000
        assert AuditBook(store, url_of(tmp_path)).verify() == []
    print(f"page back after {back_s:.2f} s")  # noqa: T201 - a figure for whoever runs it by hand


@pytest.mark.skipif(not os.environ.get("ABBE_TEST_LONG"), reason="one of nine starts of the whole service: ABBE_TEST_LONG=1 runs it")
def test_a_frozen_page_does_not_hold_up_the_end(tmp_path: Path) -> None:
    with bench(tmp_path, YEARLY) as made:
        page = made.web
        os.kill(page, signal.SIGSTOP)
        code, took_s = made.process.terminate()
        assert (code, took_s < 5.0) == (0, True)
        assert ended(page, 1.0)


@pytest.mark.skipif(not os.environ.get("ABBE_TEST_LONG"), reason="one of nine starts of the whole service: ABBE_TEST_LONG=1 runs it")
@pytest.mark.parametrize("before", ["", "pause"])
def test_stop_while_a_job_by_hand_runs_or_is_held(tmp_path: Path, before: str) -> None:
    with bench(tmp_path, YEARLY, ENDLESS) as made:
        number = made.start("endless").json()["id"]
        made.until(number, "running")
        if before:
            assert made.http.post(f"/api/v1/jobs/{number}/pause", headers=made.who["operator"]).json()["state"] == "pausing"
        code, took_s = made.process.terminate()
        assert (code, took_s < 5.0) == (0, True)
        assert "held" in made.process.lines
        assert not any("Traceback" in line for line in made.process.lines)
    assert slots_of(tmp_path) == set()


@pytest.mark.skipif(not os.environ.get("ABBE_TEST_LONG"), reason="one of nine starts of the whole service: ABBE_TEST_LONG=1 runs it")
def test_jobs_by_everybody(tmp_path: Path) -> None:
    """Who may not is told so by the web process; whom the web process lets through, the core asks about again."""
    with bench(tmp_path, YEARLY, ENDLESS) as made:
        assert made.http.post("/api/v1/jobs", json={"recipe": "quick"}).status_code == 401
        assert made.http.get("/api/v1/jobs").status_code == 401
        for role in Role:
            listed = made.http.get("/api/v1/jobs", headers=made.who[role])
            assert listed.status_code == 200
            assert listed.json()["recipes"] == ["quick", "endless"]
            may = Permission.MEASURE in ALLOWED[role]
            answer = made.start("quick", role)
            assert answer.status_code == (202 if may else 403), role
            for how in ("stop", "abort", "pause", "resume"):
                refused = made.http.post(f"/api/v1/jobs/{'0' * 12}/{how}", headers=made.who[role])
                assert refused.status_code == (404 if may else 403), (role, how)
                assert refused.headers["content-type"] == "application/problem+json"
            if may:
                assert answer.headers["location"] == f"/api/v1/jobs/{answer.json()['id']}"
                assert made.until(answer.json()["id"], "done: pass")["verification"] is not None
        made.process.terminate()
    with Store.open(url_of(tmp_path)) as store:
        records = [record for record in store.audit.events() if record.action == "POST /api/v1/jobs"]
        assert [record.who for record in records if record.outcome == "done 202"] == [
            f"token:a-{role}/test" for role in Role if Permission.MEASURE in ALLOWED[role]
        ]
        assert all("recipe quick" in record.target for record in records if record.outcome == "done 202")


@pytest.fixture(scope="module")
def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("shared")


@pytest.fixture(scope="module")
def made(shared_folder: Path) -> Iterator[Running]:
    """One service for the tests from here on: each leaves it at rest."""
    with bench(shared_folder, YEARLY, ENDLESS) as running:
        yield running


def test_live_events_are_for_those_who_may_look(made: Running) -> None:
    address, viewer = f"ws://127.0.0.1:{made.port}/api/v1/live", made.who["viewer"]
    for headers in ({}, {**viewer, "Origin": "http://evil.example"}, {"Authorization": "Bearer abbe_000000000000_" + "A" * 43}):
        with pytest.raises(InvalidStatus) as refused:
            connect(address, additional_headers=headers)
        assert refused.value.response.status_code == 403
    with connect(address, additional_headers=viewer) as live:
        first = json.loads(live.recv(timeout=10))
        assert first.keys() == {"event", "revision", "job", "devices", "mqtt_connected", "attention"}
        assert first["devices"][0]["state"] == "not used yet"
        number = made.start("quick").json()["id"]
        made.until(number, "done: pass")
        while json.loads(live.recv(timeout=10))["devices"][0]["state"] != "answered":
            pass
        live.send("hello")  # nobody listens to it
        with pytest.raises(ConnectionClosed) as closed:
            listen(live, 10)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1008


def test_a_core_that_stands_still_is_told_and_the_page_still_knows_the_past_and_goes_on_with_it(made: Running) -> None:
    viewer = made.who["viewer"]
    assert made.http.get("/readyz").status_code == 200
    with connect(f"ws://127.0.0.1:{made.port}/api/v1/live", additional_headers=viewer) as live:
        os.kill(made.process.pid, signal.SIGSTOP)
        with pytest.raises(TimeoutError):
            listen(live, 6)  # silence, for longer than the page trusts its last snapshot
    answers = [made.http.get(path, headers=viewer) for path in ("/readyz", "/api/v1/status", "/api/v1/jobs", "/")]
    assert [answer.status_code for answer in answers] == [503] * 4
    assert {answer.json()["code"] for answer in answers[:3]} == {"SRV-002"}
    assert "The core does not answer" in answers[3].text
    assert made.start("quick").status_code == 503
    assert "abbe_core_up 0.0" in made.http.get("/metrics", headers=viewer).text
    assert made.http.get("/healthz").status_code == 200
    assert made.http.get("/api/v1/verifications", headers=viewer).status_code == 200  # the past is known
    os.kill(made.process.pid, signal.SIGCONT)
    with connect(f"ws://127.0.0.1:{made.port}/api/v1/live", additional_headers=viewer) as live:
        live.recv(timeout=10)
        live.recv(timeout=10)
    assert made.http.get("/readyz").status_code == 200


def test_a_job_is_started_once_steered_and_refused_and_the_service_ends_soon(made: Running, shared_folder: Path) -> None:
    """Last of those that share a service: it ends the one whose core has stood still before."""
    first = made.start("endless", **{"Idempotency-Key": "k1"})
    number = first.json()["id"]
    again = made.start("endless", **{"Idempotency-Key": "k1"})
    assert (again.status_code, again.json()["id"]) == (202, number)
    other = made.start("quick", **{"Idempotency-Key": "k1"})
    assert (other.status_code, "another request" in other.json()["detail"]) == (409, True)
    busy = made.start("quick")
    assert (busy.status_code, "by hand: endless" in busy.json()["detail"]) == (409, True)
    assert made.start("no-such").status_code == 422
    assert made.http.post("/api/v1/jobs", json={"recipe": 7}, headers=made.who["operator"]).status_code == 422
    assert made.http.post("/api/v1/jobs", json={"recipe": "quick", "x": 1}, headers=made.who["operator"]).status_code == 422
    made.until(number, "running")
    for how, state in (("pause", "pausing"), ("resume", "running"), ("stop", "stopping")):
        answer = made.http.post(f"/api/v1/jobs/{number}/{how}", headers=made.who["operator"])
        assert (answer.status_code, answer.json()["state"] in {state, "done: cannot tell"}) == (202, True), how
    assert made.until(number, "done: cannot tell")["ended_utc"]
    late = made.http.post(f"/api/v1/jobs/{number}/stop", headers=made.who["operator"])
    assert (late.status_code, "has ended" in late.json()["detail"]) == (409, True)
    status = made.http.get("/api/v1/status", headers=made.who["viewer"]).json()
    assert status["job"] is None
    assert status["last"][0]["cause"]["code"] == "SEQ-004"
    with Store.open(url_of(shared_folder)) as store:  # whoever is shut out meanwhile: the next word of his is refused
        UserAccounts(store, SystemClock()).disable("a-operator")
    assert made.start("quick").status_code == 401
    page = made.web
    code, took_s = made.process.terminate()
    assert (code, took_s < 5.0) == (0, True)
    assert ended(page, 1.0)
    assert not any("Traceback" in line for line in made.process.lines)


def test_the_page_ends_when_the_core_is_killed(tmp_path: Path) -> None:
    with bench(tmp_path, YEARLY) as made:
        page = made.web
        made.process.kill()
        assert ended(page, 10.0)
