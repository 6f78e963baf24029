"""A core that says nothing: a screen for people, a problem document for programs, on every address."""

from __future__ import annotations

import httpx

from abbe.service.clock import SystemClock
from abbe.service.domain.verification import Verification
from abbe.service.errors import CoreUnavailable
from abbe.service.queries.reader import Reader
from abbe.service.queries.status import Status
from abbe.service.web.api.sources import Sources
from abbe.service.web.app import create_app
from tests.pages_world import Served
from tests.service.web.pages.test_screens import as_user


class Silent:
    async def status(self) -> Status:
        raise CoreUnavailable("the core of the service does not answer, for 9 s now", "look at the machine")

    async def verifications(self, limit: int) -> list[Verification]:
        return []

    async def ready(self) -> None:
        await self.status()


async def test_every_screen_says_so_and_the_api_gives_a_problem(running: Served) -> None:
    store = running.store
    app = create_app(Silent(), version="0", auth=running.auth, api=Sources(reader=Reader(store, running.filled.machine, SystemClock())))
    with as_user(running, "adam") as known:
        headers = dict(known.headers) | {"host": "127.0.0.1"}
    async with httpx.AsyncClient(transport=httpx.ASGITransport(app, False), base_url="http://127.0.0.1", headers=headers) as client:
        screens = ("/", "/runs", "/result", "/trends", "/schedule", "/fleet", "/devices", "/settings", "/diagnostics", "/run?id=1")
        moving = ("/live", "/new")
        for path in (*screens, *moving):
            answer = await client.get(path, headers={"Accept": "text/html,*/*;q=0.8"})
            assert (answer.status_code, answer.headers["retry-after"]) == (503, "5"), path
            assert answer.headers["content-type"].startswith("text/html"), path
            assert "does not answer, for 9 s" in answer.text, path
            assert "<nav" in answer.text, path
        for path in ("/api/v1/status", "/runs", *moving):
            answer = await client.get(path, headers={"Accept": "text/html" if path.startswith("/api/") else "*/*"})
            assert (answer.status_code, answer.headers["content-type"], answer.json()["code"]) == (
                503,
                "application/problem+json",
                "SRV-002",
            )


async def test_people_get_errors_as_screens_with_stop_and_programs_get_problems(running: Served) -> None:
    wrong = {"/nosuch": 404, "/run?id=abc": 422, "/audit": 403, "/run?id=99": 404, "/diagnostics/nothing": 404}
    with as_user(running, "olga", Accept="text/html", **{"Accept-Language": "de"}) as client:
        for path, status in wrong.items():
            answer = client.get(path)
            assert (answer.status_code, answer.headers["content-type"]) == (status, "text/html; charset=utf-8"), path
            assert 'id="stop"' in answer.text, path
            assert '<html lang="de"' in answer.text, path
            assert answer.headers["content-security-policy"].startswith("default-src 'self'")
        assert "Ihre Rolle darf das nicht" in client.get("/audit").text
        assert client.get("/api/v1/nosuch").json()["code"] == "WEB-404"
    with as_user(running, "olga") as program:
        assert program.get("/nosuch").json()["code"] == "WEB-404"
    async with httpx.AsyncClient(base_url=running.base, headers={"Accept": "text/html"}) as stranger:
        page = (await stranger.get("/nosuch")).text
        assert running.filled.machine not in page, "who is not logged in learns nothing of the machine"
