"""What no database can hold, and what is far too long, in every text of every query: an answer, never a defect, on both databases."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import httpx
import pytest
from starlette.routing import Route

from abbe.service.audit.book import AuditBook
from abbe.service.clock import SystemClock
from abbe.service.core.board import Board
from abbe.service.domain.schedule import Schedule
from abbe.service.queries.reader import Reader
from abbe.service.queries.status import StatusReader
from abbe.service.storage.store import Store
from abbe.service.users.people import Passwords, UserAccounts
from abbe.service.web.api.sources import Sources
from abbe.service.web.app import create_app
from abbe.service.web.login.auth_middleware import CSRF_HEADER
from abbe.service.web.login.authentication import COOKIE, Authenticator, csrf_token

PHRASE = "correct horse battery staple"
LONG = os.environ.get("ABBE_TEST_LONG") == "1"
ODD = ("a%00b", quote("x" * 6000)) + (("%00", "%ed%a0%80", "%27%3B--", "%C3%28", "\u202e") if LONG else ())


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    yield f"sqlite:///{tmp_path / 'abbe.sqlite3'}" if request.param == "sqlite" else request.getfixturevalue("postgres")()
    shutil.rmtree(tmp_path, ignore_errors=True)


async def test_every_text_of_every_query(url: str) -> None:
    clock = SystemClock()
    with Store.open(url) as store:
        people = UserAccounts(store, clock, Passwords(memory_kib=64, passes=1))
        people.add("adam", "admin", PHRASE)
        auth = Authenticator(store, people, AuditBook(store, url), rate_hz=1e9, burst=1e9)
        board = Board({}, clock)
        schedules = (Schedule("s", "0 6 * * *", "UTC", "r"),)
        view = StatusReader(Reader(store, "m", clock), "0", board, list, "")
        app = create_app(view, version="0", auth=auth, api=Sources(reader=view.reader, schedules=schedules))
        secret = people.begin(people.get("adam"))
        headers = {"Cookie": f"{COOKIE}={secret}", CSRF_HEADER: csrf_token(secret), "Origin": "http://127.0.0.1"}
        found: dict[str, int] = {}
        async with httpx.AsyncClient(transport=httpx.ASGITransport(app, False), base_url="http://127.0.0.1", headers=headers) as client:
            for route in app.routes:
                names = [f.alias for f in route.dependant.query_params] if isinstance(route, Route) and hasattr(route, "dependant") else []
                for name in names:
                    path = f"{route.path.replace('{number}', '1')}?{name}="
                    found |= {path + odd[:20]: (await client.get(path + odd)).status_code for odd in ODD if "{" not in path}
            for odd in ODD[:1]:
                form = f"name={odd}&password={odd}"
                plain = {"Content-Type": "application/x-www-form-urlencoded"}
                found["login " + odd] = (await client.post("/login", content=form, headers=plain)).status_code
                found["job " + odd] = (await client.post(f"/api/v1/proposals/{odd}/approve")).status_code
        wrong = {path: status for path, status in found.items() if status >= 500}
        assert wrong == {}
        assert len(found) > 90
        assert {found["/runs?campaign=a%00b"], found["/fleet?name=a%00b"]} == {422}
        assert {found["/api/v1/runs?campaign=a%00b"], found["/api/v1/trends?machine=a%00b"]} == {200}
