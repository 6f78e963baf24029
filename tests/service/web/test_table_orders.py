"""The order that takes a table back, over HTTP: the right is asked at the auth, the rest is the core's answer."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

import httpx
import pytest
from fastapi import FastAPI

from abbe.service.channel.messages import Answer, Jobs, Outcome, PushNow, RollBack, Wire, from_web
from abbe.service.clock import SystemClock
from abbe.service.core.board import Board
from abbe.service.domain.people import ALLOWED, Permission, Role
from abbe.service.domain.progress import JobState
from abbe.service.queries.reader import Reader
from abbe.service.queries.status import StatusReader
from abbe.service.web.api.once import REPLAYED
from abbe.service.web.api.sources import Sources
from abbe.service.web.app import Parts, create_app
from abbe.service.web.core_link.core_line import CoreLine
from abbe.service.web.login.access import route_permissions
from abbe.service.web.problems import MEDIA_TYPE
from tests.service.core.test_channel import MOMENT
from tests.service.web.api_bench import NAME, Plant

BASE, PATH = "http://127.0.0.1:8080", "/api/v1/tables/rollback"
JOB = JobState(
    id="0123456789ab",
    kind="rollback",
    recipe="rollback of push 1",
    schedule="",
    who="user:a",
    state="running",
    text="",
    begun_utc=datetime(2026, 11, 22, tzinfo=UTC),
)
BODY = {"push": 1, "crc": "0BADCAFE", "reason": "worse"}


@dataclass
class Desk:
    """The application, and the other end of its channel, which answers as it is told to."""

    app: FastAPI
    client: httpx.AsyncClient
    asked: list[RollBack | PushNow] = field(default_factory=list)
    answer: tuple[Outcome, str, str] = ("done", "", JOB.id)

    async def post(self, who: dict[str, str], body: Any = BODY, key: str = "k") -> httpx.Response:
        return await self.client.post(PATH, json=body, headers={"Origin": BASE, **who, **({"Idempotency-Key": key} if key else {})})

    async def core(self, far: Wire) -> None:
        far.send(Jobs("jobs", (JOB,)))
        far.send(MOMENT)
        while (body := await far.receive()) is not None:
            message = from_web(body)
            assert isinstance(message, RollBack | PushNow)
            self.asked.append(message)
            outcome, text, job = self.answer
            far.send(Answer("answer", message.request, outcome, text, job))


@pytest.fixture
async def desk(plant: Plant) -> AsyncIterator[Desk]:
    ours, theirs = socket.socketpair()
    near, far = await Wire.over(ours), await Wire.over(theirs)
    core = CoreLine(near, SystemClock())
    view = StatusReader(Reader(plant.store, NAME, plant.clock), "0.1.0", Board({}, plant.clock), list, "")
    sources = Sources(reader=view.reader)
    app = create_app(view, version="0.1.0", auth=plant.auth, api=sources, parts=Parts(core, plant.store, NAME, ()))
    async with httpx.AsyncClient(transport=httpx.ASGITransport(app, False), base_url=BASE) as client:
        made = Desk(app, client)
        tasks = [asyncio.create_task(core.listen()), asyncio.create_task(made.core(far))]
        with core.listener() as moments:
            assert moments is not None
            await anext(moments())
        yield made
        near.close()
        far.close()
        for task in tasks:
            task.cancel()


async def test_only_who_approves_gets_to_the_core(desk: Desk, plant: Plant) -> None:
    assert [need for method, path, need in route_permissions(desk.app.routes) if path == PATH] == [Permission.APPROVE]
    assert (await desk.client.post(PATH, json=BODY, headers={"Origin": BASE})).status_code == 401
    for role in Role:
        may = Permission.APPROVE in ALLOWED[role]
        for who in (plant.session(role), plant.token(role)):
            before = len(desk.asked)
            answer = await desk.post(who)
            assert (answer.status_code, len(desk.asked) - before) == ((202, 1) if may else (403, 0)), role
    last = desk.asked[-1]
    assert isinstance(last, RollBack)
    assert (last.push, last.crc, last.reason, last.key, last.who.split("/")[0]) == (1, 0x0BADCAFE, "worse", "k", "token:a-approver")
    assert (await desk.post(plant.session("approver") | {"X-CSRF-Token": "x"})).status_code == 403


async def test_the_answer_is_the_core_s(desk: Desk, plant: Plant) -> None:
    who = plant.token("approver")
    answer = await desk.post(who)
    assert (answer.headers["location"], answer.json()["kind"], REPLAYED in answer.headers) == (f"/api/v1/jobs/{JOB.id}", "rollback", False)
    desk.answer = ("done", "already requested with this key", JOB.id)
    answer = await desk.post(who)
    assert (answer.status_code, answer.headers[REPLAYED]) == (202, "true")
    assert plant.store.audit.events(1)[0].outcome == "replayed 202"
    for outcome, status in (("forbidden", 403), ("conflict", 409), ("busy", 409)):
        desk.answer = (outcome, "one clear line", "")  # type: ignore[assignment]
        answer = await desk.post(who)
        assert (answer.status_code, answer.headers["content-type"], answer.json()["detail"]) == (status, MEDIA_TYPE, "one clear line")


WRONG = (
    {"push": 0}, {"push": "x"}, {"crc": "1234567"}, {"crc": "0xBADCAF"}, {"reason": ""}, {"reason": " \n"},
    {"reason": "x" * 501}, {"to": 0},
)  # fmt: skip


@pytest.mark.parametrize("change", WRONG)
async def test_what_is_not_an_order_is_refused_at_the_door(desk: Desk, plant: Plant, change: dict[str, Any]) -> None:
    assert (await desk.post(plant.token("approver"), BODY | change)).status_code == 422
    assert desk.asked == []


async def test_an_order_needs_a_key(desk: Desk, plant: Plant) -> None:
    assert (await desk.post(plant.token("approver"), key="")).status_code == 422
    assert desk.asked == []


async def test_a_push_is_ordered_by_whoever_approves(desk: Desk, plant: Plant) -> None:
    path = PATH.replace("tables/rollback", "proposals/3/push")
    for role in Role:
        headers = {**plant.token(role), "Idempotency-Key": "k"}
        answer = await desk.client.post(path, json={}, headers=headers)
        assert answer.status_code == (202 if role == Role.APPROVER else 403), role
    (asked,) = desk.asked
    assert isinstance(asked, PushNow)
    assert (asked.proposal, asked.key, asked.who.split("/")[0]) == (3, "k", "token:a-approver")
    desk.answer = ("unknown", "no proposal 3", "")
    assert (await desk.client.post(path, json={}, headers=plant.token("approver") | {"Idempotency-Key": "l"})).status_code == 404


async def test_the_screen_shows_the_journal(desk: Desk, plant: Plant) -> None:
    answer = await desk.client.get("/table", headers=plant.session("approver"))
    assert answer.status_code == 200
    assert "from before the first push" in answer.text
    assert "no push of this machine was kept" in answer.text
    assert "TEMPERATURE: the shop is too warm" in answer.text
    assert "<dialog" not in answer.text
