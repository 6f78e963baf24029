"""A table in force is ordered back over HTTP: a real service, a simulated controller, a pushed table; who may not is refused."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from abbe.service.audit.book import AuditBook
from abbe.service.clock import SystemClock
from abbe.service.domain.push_entry import PushState
from abbe.service.push.journal import check_chain
from abbe.service.storage.store import Store
from abbe.service.users.people import Passwords, UserAccounts
from abbe.service.web.api.once import REPLAYED
from tests.scenarios.conftest import Sims, simulated
from tests.scenarios.test_push import bench, push, steep
from tests.scenarios.world import wait_for
from tests.system.serve_bench import abbe, free_port
from tests.system.test_serve_recovery import table_in_force

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(120)]
PHRASE = "correct horse battery staple"
REASON = "the shop's gauge block says it is worse"


async def pushed(sims: Sims, folder: Path) -> tuple[int, int]:
    """CRC of the table in force before a kept push, and of the one it brought."""
    before = (await table_in_force(sims.ready["cnc"]))[1]
    async with bench(sims, folder) as (site, store, session):
        done = await push(session.controller, store, site, steep(site))
        assert done.kept
        return before, done.crc


def tokens(url: str) -> dict[str, dict[str, str]]:
    with Store.open(url) as store:
        people = UserAccounts(store, SystemClock(), Passwords(memory_kib=64, passes=1))
        found = {}
        for name, role, scopes in (("ann", "approver", ["read", "approve"]), ("bob", "operator", ["read", "measure"])):
            people.add(name, role, PHRASE)
            found[name] = {"Authorization": f"Bearer {people.add_token(name, 'test', scopes, 1.0)}"}
        return found


@contextmanager
def client(port: int) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=30) as http:
        yield http


def ended(http: httpx.Client, place: str, who: dict[str, str]) -> dict[str, Any]:
    """The job, once it has ended."""

    def job() -> dict[str, Any]:
        return dict(http.get(place, headers=who).json())

    wait_for(lambda: job()["ended_utc"] is not None, 60, "the end of the job")
    return job()


def test_an_approver_orders_the_table_back_and_an_operator_does_not(tmp_path: Path) -> None:
    url, port = f"sqlite:///{tmp_path / 'abbe.sqlite3'}", free_port()
    with simulated(tmp_path, "--speed", "30", "--seed", "2", extra=f"[web]\nport = {port}") as sims:
        old, new = asyncio.run(pushed(sims, tmp_path))
        assert old != new
        who = tokens(url)
        with closing(abbe("serve", "-m", sims.machine_file)) as running, client(port) as http:
            running.expect('"page up"')

            def order(name: str, crc: int = new, push: int = 1, key: str = "k1") -> httpx.Response:
                body = {"push": push, "crc": f"{crc:08X}", "reason": REASON}
                return http.post("/api/v1/tables/rollback", json=body, headers={**who[name], "Idempotency-Key": key})

            assert order("bob").status_code == 403
            assert f"{new:08X}" in http.get("/table", headers=who["bob"]).text
            wrong = order("ann", old, key="k0")
            assert (wrong.status_code, wrong.headers["content-type"]) == (409, "application/problem+json")
            assert "another table has come into force meanwhile" in wrong.json()["detail"]
            assert asyncio.run(table_in_force(sims.ready["cnc"]))[1] == new

            sent = order("ann")
            assert sent.status_code == 202, sent.text
            job = ended(http, sent.headers["Location"], who["ann"])
            assert (job["kind"], job["who"].split("/")[0], job["state"]) == ("rollback", "token:ann", "done: kept"), job
            assert asyncio.run(table_in_force(sims.ready["cnc"]))[1] == old
            again = order("ann")
            assert (again.status_code, again.headers["Location"], again.headers[REPLAYED]) == (202, sent.headers["Location"], "true")
            assert "was itself a rollback" in order("ann", old, 2, "k2").json()["detail"]
            assert running.terminate()[0] == 0
    with Store.open(url) as store:
        entries = store.pushes.entries("sim")
        check_chain(entries)
        assert (entries[-1].push, entries[-1].state) == (2, PushState.KEEP)
        assert next(e for e in entries if e.push == 2 and e.state is PushState.APPROVED).doc["approved_by"] == "token:ann/test: rollback"
        told = [(r.who, r.outcome, r.doc["reason"]) for r in store.audit.events() if r.action == "rollback"]
        assert told == [("token:ann/test", "begun", REASON), ("token:ann/test", "kept", REASON)]
        asked = [(r.who, r.outcome) for r in store.audit.events() if r.action == "POST /api/v1/tables/rollback"]
        assert asked == [
            ("token:bob/test", "refused 403"), ("token:ann/test", "refused 409"), ("token:ann/test", "done 202"),
            ("token:ann/test", "replayed 202"), ("token:ann/test", "refused 409"),
        ]  # fmt: skip
        assert AuditBook(store, url).verify() == []
