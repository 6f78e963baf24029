"""Real sockets that say nothing, or say it for ever: they are let go, and who asks is served meanwhile."""

from __future__ import annotations

import asyncio
import ssl
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from fastapi import FastAPI, Request
from fastapi.responses import PlainTextResponse

from abbe.service.web import problems
from abbe.service.web.listening import bind
from abbe.service.web.login import connections
from abbe.service.web.process import serving as server
from abbe.service.web.process.serving import Server, make_server
from tests.system.test_serve_users import certificate

Stream = tuple[asyncio.StreamReader, asyncio.StreamWriter]
ASK = b"GET /hello HTTP/1.1\r\nHost: 127.0.0.1\r\n"
PATIENCE_S = 20.0


def small_app() -> FastAPI:
    app = FastAPI()
    problems.install(app)

    @app.get("/hello")
    async def hello() -> PlainTextResponse:
        return PlainTextResponse("hello")

    @app.get("/large")
    async def large() -> PlainTextResponse:
        return PlainTextResponse("x" * 50_000_000)

    @app.post("/form")
    async def form(request: Request) -> PlainTextResponse:
        return PlainTextResponse(str(len(await request.body())))

    @app.post("/early")
    async def early() -> PlainTextResponse:
        return PlainTextResponse("no", 413)

    return app


@dataclass
class Site:
    running: Server
    port: int
    streams: list[Stream] = field(default_factory=list)

    async def opened(self, first: bytes = b"") -> Stream:
        stream = await asyncio.open_connection("127.0.0.1", self.port)
        self.streams.append(stream)
        with suppress(ConnectionError):  # let go already
            stream[1].write(first)
            await stream[1].drain()
        return stream

    async def asked(self, tls: ssl.SSLContext | None = None) -> tuple[bytes, float]:
        """First line of the answer to a real question, and seconds."""
        began_s = time.monotonic()
        stream = await asyncio.open_connection("127.0.0.1", self.port, ssl=tls)
        self.streams.append(stream)
        stream[1].write(ASK + b"Connection: close\r\n\r\n")
        answer = await is_let_go(stream)
        return answer.partition(b"\r\n")[0], time.monotonic() - began_s


@asynccontextmanager
async def serving(folder: Path | None = None) -> AsyncIterator[Site]:
    files = ("", "") if folder is None else (str(folder / "abbe.crt"), str(folder / "abbe.key"))
    listening = bind("127.0.0.1", 0)
    running = make_server(small_app(), *files)
    work = asyncio.create_task(running.serve(sockets=[listening]))
    while not running.started:  # noqa: ASYNC110 - uvicorn has a flag, no event
        await asyncio.sleep(0)
    site = Site(running, listening.getsockname()[1])
    try:
        yield site
    finally:
        for _, writer in site.streams:
            writer.transport.abort()
        running.should_exit = True
        await work


async def is_let_go(stream: Stream) -> bytes:
    """What is read until the other side ends the connection."""
    try:
        async with asyncio.timeout(PATIENCE_S):
            return await stream[0].read()
    except ConnectionError:
        return b""


async def test_a_visitor_is_served_among_hundreds_who_say_nothing() -> None:
    async with serving() as site:
        silent = [await site.opened() for _ in range(250)]
        silent += [await site.opened(ASK + b"X-Slow: ") for _ in range(100)]
        silent += [await site.opened(b"POST /form HTTP/1.1\r\nHost: a\r\nContent-Length: 100\r\n\r\nslow") for _ in range(100)]
        answers = [await site.asked() for _ in range(5)]
        assert {line for line, _ in answers} == {b"HTTP/1.1 200 OK"}
        assert max(took_s for _, took_s in answers) < connections.HEADERS_S / 2  # nobody's time has run out
        assert len(site.running.server_state.connections) <= 200
        async with asyncio.timeout(connections.HEADERS_S / 3):  # the one that has been silent longest, and not because of its own time
            assert await is_let_go(silent[0]) == b""


async def test_who_is_connected_and_asks_stays_while_others_come() -> None:
    """Room is made by those who are silent longest: not by one who has just been answered."""
    async with serving() as site:
        regular = await site.opened()
        silent = []
        for _ in range(6):
            silent += [await site.opened() for _ in range(60)]
            regular[1].write(ASK + b"\r\n")
            async with asyncio.timeout(PATIENCE_S):
                assert (await regular[0].readuntil(b"hello")).startswith(b"HTTP/1.1 200 OK")


@pytest.mark.parametrize(
    "said",
    [
        b"",
        b"G",
        ASK,
        ASK + b"\r\n" + ASK,  # the second question of a connection
        b"POST /form HTTP/1.1\r\nHost: a\r\nContent-Length: 100\r\n\r\nslow",
        b"POST /form HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: chunked\r\n\r\n4\r\nslow\r\n",
    ],
)
@pytest.mark.parametrize("drop_by_drop", [False, True])
async def test_what_does_not_come_to_its_end_is_cut(said: bytes, drop_by_drop: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "HEADERS_S", 1.0)
    monkeypatch.setattr(connections, "BODY_S", 1.0)
    async with serving() as site:
        stream = await site.opened(said)
        ended = asyncio.create_task(is_let_go(stream))
        began_s = time.monotonic()
        while drop_by_drop and not ended.done():
            assert time.monotonic() - began_s < PATIENCE_S
            stream[1].write(b"1" if said.startswith(b"POST") and b"chunked" not in said else b"")
            if b"\r\n" in said and not said.startswith(b"POST"):
                stream[1].write(b"X-A: b\r\n")
            await asyncio.wait({ended}, timeout=0.05)
        answer = await ended
        assert time.monotonic() - began_s < 5.0  # not uvicorn's: it has no such end
        assert answer.count(b"200 OK") == said.count(ASK + b"\r\n")


@pytest.mark.parametrize("how", [b"Content-Length: 100000000", b"Transfer-Encoding: chunked"])
async def test_a_body_that_was_refused_is_thrown_away_for_a_while_then_cut(how: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "LINGER_S", 0.5)
    async with serving() as site:
        stream = await site.opened(b"POST /early HTTP/1.1\r\nHost: a\r\n" + how + b"\r\n\r\n")
        assert (await stream[0].readuntil(b"no")).startswith(b"HTTP/1.1 413")
        began_s = time.monotonic()
        with pytest.raises(ConnectionError):  # noqa: PT012 - it goes on sending until it is cut
            while time.monotonic() - began_s < PATIENCE_S:
                stream[1].write(b"5\r\nslow!\r\n" if b"chunked" in how else b"slow!")
                await stream[1].drain()
                await asyncio.sleep(0.01)
        assert 0.3 < time.monotonic() - began_s < 10.0


async def test_an_answer_that_nobody_reads_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "READ_S", 0.3)
    async with serving() as site:
        stream = await site.opened(ASK.replace(b"hello", b"large") + b"\r\n")
        stream[1].transport.pause_reading()  # type: ignore[attr-defined]
        async with asyncio.timeout(PATIENCE_S):
            while not site.running.server_state.total_requests:  # noqa: ASYNC110 - uvicorn counts, it has no event
                await asyncio.sleep(0.01)
            answered_s = time.monotonic()
            while site.running.server_state.connections:  # noqa: ASYNC110
                await asyncio.sleep(0.01)
        assert time.monotonic() - answered_s < 3.0  # not uvicorn's: its end of idle connections waits for the reader


async def test_a_handshake_that_does_not_come_to_its_end_is_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "HANDSHAKE_S", 2.0)
    certificate(tmp_path)
    known = ssl.create_default_context(cafile=tmp_path / "abbe.crt")
    async with serving(tmp_path) as site:
        silent = [await site.opened() for _ in range(50)]
        assert (await site.asked(known))[0] == b"HTTP/1.1 200 OK"
        for stream in silent:
            assert await is_let_go(stream) == b""
