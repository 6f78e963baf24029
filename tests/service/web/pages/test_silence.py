"""A core that says nothing: a screen for people, a problem document for programs, on every address."""

from __future__ import annotations

import re
from html import unescape

import httpx
import pytest

from abbe.service.clock import SystemClock
from abbe.service.domain.verification import Verification
from abbe.service.errors import CoreUnavailable
from abbe.service.queries.reader import Reader
from abbe.service.queries.status import Status
from abbe.service.rendering.phrases import LANGUAGES
from abbe.service.web.api.sources import Sources
from abbe.service.web.app import create_app
from abbe.service.web.language import catalogue
from abbe.service.web.login.authentication import Authenticator
from abbe.service.web.problems import MEDIA_TYPE
from tests.languages import english
from tests.pages_world import Served
from tests.service.web.pages.test_screens import as_user


class Silent:
    async def status(self) -> Status:
        raise CoreUnavailable("the core of the service has not answered for 9 s", "check the machine, then the service's log")

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
            assert "has not answered for 9 s" in answer.text, path
            assert "<nav" in answer.text, path
        answer = await client.get("/api/v1/status", headers={"Accept": "text/html", "Accept-Language": "de"})
        assert (answer.status_code, "antwortet seit 9 s nicht" in answer.text) == (503, True)
        for path in ("/api/v1/status", "/runs", *moving):
            answer = await client.get(path, headers={"Accept": "*/*"})
            assert (answer.status_code, answer.headers["content-type"], answer.json()["code"]) == (
                503,
                "application/problem+json",
                "SRV-002",
            )


WRONG = {
    "/nosuch": 404,
    "/run?id=abc": 422,
    "/audit": 403,
    "/run?id=99": 404,
    "/diagnostics/nothing": 404,
    "/api/v1/nosuch": 404,
    "/api/v1/reports/verification/999": 404,
    "/api/v1/runs/0": 404,
    "/api/v1/users": 403,
    "/proposal/approve": 405,
}
"""Each kind of refusal that an address can bring about, in the screens and in the interface: a link to a report leads there."""
OWN_SCREEN = "/run?id=99"
"""The screen of a thing that is not there says so itself, to programs too."""


def text_of(page: str) -> str:
    """The words of a screen without those that it marks as English."""
    shown = re.sub(r'<p[^>]* lang="en">.*?</p>', "", re.split(r"<main[^>]*>|</main>", page)[1], flags=re.DOTALL)
    return unescape(re.sub(r"<[^>]+>", " ", shown))


@pytest.mark.parametrize("lang", LANGUAGES)
async def test_people_get_errors_as_screens_with_stop_and_programs_get_problems(running: Served, lang: str) -> None:
    with as_user(running, "olga", Accept="text/html,*/*;q=0.8", **{"Accept-Language": lang}) as client, as_user(running, "olga") as program:
        for path, status in WRONG.items():
            answer, told = client.get(path), program.get(path)
            assert (answer.status_code, answer.headers["content-type"]) == (status, "text/html; charset=utf-8"), path
            assert 'id="stop"' in answer.text, path
            assert f'<html lang="{lang}"' in answer.text, path
            assert answer.headers["content-security-policy"].startswith("default-src 'self'")
            if path == OWN_SCREEN:
                assert (told.status_code, told.headers["content-type"]) == (status, "text/html; charset=utf-8")
                continue
            assert (told.headers["content-type"], told.json()["status"]) == (MEDIA_TYPE, status), path
            assert f">{catalogue(lang)[f'error.{status}']}</h1>" in answer.text, path
            assert lang == "en" or english(lang, text_of(answer.text), ()) == set(), path
    async with httpx.AsyncClient(base_url=running.base, headers={"Accept": "text/html"}) as stranger:
        page = (await stranger.get("/nosuch")).text
        assert running.filled.machine not in page, "who is not logged in learns nothing of the machine"
        answer = await stranger.get("/", headers={"Host": "elsewhere.example"})
        assert (answer.status_code, "<nav" in answer.text, running.filled.machine in answer.text) == (400, True, False)


async def test_a_defect_too_many_requests_and_a_store_that_is_gone_are_screens(running: Served) -> None:
    class Broken(Silent):
        async def status(self) -> Status:
            raise KeyError("a defect")

    slow = Authenticator(running.store, running.people, running.auth.book, rate_hz=1e-9, burst=4.0)
    for source, auth, status in ((Broken(), running.auth, 500), (Silent(), slow, 429)):
        app = create_app(source, version="0", auth=auth, api=Sources(reader=Reader(running.store, running.filled.machine, SystemClock())))
        with as_user(running, "adam") as known:
            headers = dict(known.headers) | {"host": "127.0.0.1", "Accept": "text/html", "Accept-Language": "ja"}
        async with httpx.AsyncClient(transport=httpx.ASGITransport(app, False), base_url="http://127.0.0.1", headers=headers) as client:
            answers = [await client.get("/runs") for _ in range(5)]
        assert answers[-1].status_code == status
        assert f">{catalogue('ja')[f'error.{status}']}</h1>" in answers[-1].text
