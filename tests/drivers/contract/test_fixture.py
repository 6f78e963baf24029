"""The fixture drivers against a TCP peer that can misbehave, and the operator at the console."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator

import pytest

from abbe.drivers.errors import BadFrame, BadUrl, LinkDown, Refused, ReplyTimeout
from abbe.drivers.fixture.driver import ConsoleFixture, RemoteFixture
from abbe.drivers.links.urls import FixtureTcpUrl
from abbe.drivers.registry import open_ballbar, open_controller, open_fixture, open_laser


class FixturePeer:
    async def start(self) -> None:
        self.asked: list[dict] = []
        self.answers: list[bytes | None] = []
        self.got = asyncio.Event()
        self.server = await asyncio.start_server(self.serve, "127.0.0.1", 0)
        self.port = self.server.sockets[0].getsockname()[1]
        self.url = f"fixture+tcp://127.0.0.1:{self.port}"

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while line := await reader.readline():
            request = json.loads(line)
            self.asked.append(request)
            self.got.set()
            answer: bytes | None = json.dumps({"id": request["id"], "ok": True, "time_us": 1, "name": "peer"}).encode() + b"\n"
            if self.answers:
                answer = self.answers.pop(0)
            if answer is None:
                continue
            if answer == b"hang up":
                break
            writer.write(answer.replace(b"ID", str(request["id"]).encode()))
        writer.close()


@pytest.fixture
async def peer() -> AsyncIterator[FixturePeer]:
    made = FixturePeer()
    await made.start()
    yield made
    made.server.close()
    await made.server.wait_closed()


@pytest.fixture
async def fixture(peer) -> AsyncIterator[RemoteFixture]:
    opened = RemoteFixture(FixtureTcpUrl("127.0.0.1", peer.port), mount_timeout_s=0.1)
    yield opened
    await opened.close()


async def test_all_operations(peer, fixture):
    await fixture.mount_ballbar(150.0)
    await fixture.take_out_ballbar()
    await fixture.change_ballbar(100.0)
    await fixture.mount_laser((0.6, 0.0, 0.8))
    await fixture.unmount()
    assert await fixture.identify() == "peer"
    assert peer.asked == [
        {"id": 1, "op": "mount_ballbar", "radius_mm": 150.0},
        {"id": 2, "op": "take_out_ballbar"},
        {"id": 3, "op": "change_ballbar", "radius_mm": 100.0},
        {"id": 4, "op": "mount_laser", "beam": [0.6, 0.0, 0.8]},
        {"id": 5, "op": "unmount"},
        {"id": 6, "op": "identify"},
    ]


async def test_refusal_says_why(peer, fixture):
    peer.answers = [b'{"id": ID, "ok": false, "error": "no bar of 151 mm"}\n']
    with pytest.raises(Refused, match="no bar of 151 mm"):
        await fixture.mount_ballbar(151.0)
    await fixture.unmount()


@pytest.mark.parametrize(
    "answer",
    [
        b"hello\n",
        b"\xff\xfe\n",
        b"[]\n",
        b'{"id": 99, "ok": true}\n',
        b'{"id": ID}\n',
        b'{"id": ID, "ok": "yes"}\n',
        b"x" * 70_000 + b"\n",
        b"[" * 60_000 + b"\n",
    ],
)
async def test_nonsense_is_refused_and_the_connection_renewed(peer, fixture, answer):
    peer.answers = [answer]
    with pytest.raises(BadFrame):
        await fixture.unmount()
    await fixture.unmount()


async def test_silence(peer, fixture):
    peer.answers = [None]
    with pytest.raises(ReplyTimeout, match="not done within"):
        await fixture.unmount()
    await fixture.unmount()


async def test_hang_up(peer, fixture):
    peer.answers = [b"hang up"]
    with pytest.raises(LinkDown):
        await fixture.unmount()
    await fixture.unmount()


async def test_a_late_answer_to_a_cancelled_question_is_never_heard(peer, fixture):
    peer.answers = [None]
    task = asyncio.create_task(fixture.unmount())
    await peer.got.wait()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    await fixture.mount_ballbar(150.0)


async def test_registry(peer):
    fixture = await open_fixture(peer.url, None)
    await fixture.unmount()
    await fixture.close()
    await fixture.close()
    assert [asked["op"] for asked in peer.asked][-1] == "unmount"


async def test_nobody_there(peer):
    peer.server.close()
    with pytest.raises(LinkDown, match="fixture is running"):
        await open_fixture(peer.url, None)


async def test_the_operator_is_asked():
    asked: list[str] = []

    async def ask(text: str) -> None:
        asked.append(text)

    fixture = await open_fixture("fixture+console:", ask)
    assert isinstance(fixture, ConsoleFixture)
    await fixture.mount_ballbar(150.0)
    await fixture.mount_laser((0.6, 0.0, -0.8))
    await fixture.unmount()
    await fixture.close()
    assert ["150 mm" in asked[0], "Z -0.8000" in asked[1], "away" in asked[2]] == [True] * 3


@pytest.mark.parametrize("opener", [open_ballbar, open_laser, open_controller, lambda url: open_fixture(url, None)])
@pytest.mark.parametrize("url", ["serial:///dev/x", "modbus+tcp://h:502", "fixture+tcp://h:1"])
async def test_wrong_schemes(opener, url):
    fits = {open_ballbar: "serial", open_laser: "modbus", open_controller: "modbus"}.get(opener, "fixture")
    if url.startswith(fits):
        return
    with pytest.raises(BadUrl, match="not the URL of"):
        await opener(url)
