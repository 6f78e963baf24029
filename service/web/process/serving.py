"""Assembles the web process from channel, store, users, application and server, and ends it with the core."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Iterator
from contextlib import contextmanager

import structlog
import uvicorn
from fastapi import FastAPI

from abbe.service.audit.book import AuditBook
from abbe.service.channel.messages import PROTOCOL, Begin, Serving, WebHeartbeat, Wire, from_core
from abbe.service.clock import SystemClock
from abbe.service.errors import AbbeError, ChannelBroken
from abbe.service.plant.gather import Gatherer
from abbe.service.queries.reader import Reader
from abbe.service.queries.status import StatusReader
from abbe.service.storage.store import Store
from abbe.service.users.people import UserAccounts
from abbe.service.web.api.sources import Sources, capture_log
from abbe.service.web.app import Parts, create_app
from abbe.service.web.core_link.core_line import CoreLine
from abbe.service.web.login.authentication import Authenticator, Endpoint
from abbe.service.web.login.connections import TimeLimitedProtocol
from abbe.service.web.pages.rehearsal import Rehearsals

HANDSHAKE_S = 10.0
LONGEST_MESSAGE_B = 1024
"""WebSocket clients have nothing to send; a longer message ends the connection."""


class Server(uvicorn.Server):
    """uvicorn without signal handlers, since the service stops its parts in its own order. ``answers`` is set once it serves."""

    def __init__(self, config: uvicorn.Config) -> None:
        super().__init__(config)
        self.answers = asyncio.Event()

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Capture no signals."""
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start to serve, then set ``answers``."""
        await self._listen(sockets)
        self.answers.set()

    async def _listen(self, sockets: list[socket.socket] | None) -> None:
        """Listen, with a shorter limit for TLS handshakes than asyncio's minute."""
        if self.config.ssl is None or sockets is None:
            await super().startup(sockets)
            return
        await super().startup([])  # everything but listening: uvicorn has no setting for the duration of a handshake

        def protocol() -> asyncio.Protocol:
            return TimeLimitedProtocol(config=self.config, server_state=self.server_state, app_state=self.lifespan.state)

        loop, tls = asyncio.get_running_loop(), self.config.ssl
        for listening in sockets:
            self.servers.append(await loop.create_server(protocol, sock=listening, ssl=tls, ssl_handshake_timeout=HANDSHAKE_S))


def make_server(app: FastAPI, certificate: str = "", key: str = "") -> Server:
    """A server for ``app``; run it with ``await server.serve(sockets=[...])``, end it with ``should_exit``.

    ``certificate``, ``key``: PEM files that `check_certificate` has accepted; empty: plain HTTP. Python's defaults refuse TLS below 1.2.
    """
    return Server(
        uvicorn.Config(
            app,
            ssl_certfile=certificate or None,
            ssl_keyfile=key or None,
            log_config=None,
            access_log=False,
            lifespan="off",
            http=TimeLimitedProtocol,
            ws="websockets-sansio",
            ws_max_size=LONGEST_MESSAGE_B,
            ws_ping_interval=20.0,
            ws_ping_timeout=20.0,
            ws_per_message_deflate=False,
            server_header=False,
            proxy_headers=False,
            timeout_keep_alive=5,
            timeout_graceful_shutdown=1,
            # The protocol limits connections: uvicorn would count idle ones as well.
            limit_concurrency=None,
        )
    )


log = structlog.get_logger("abbe.web")

ALIVE_S = 2.0


async def serve_pages(channel: socket.socket, listening: socket.socket) -> int:
    """Serve until the channel ends; return the exit code. An error is one line in the log; the core starts a new process."""
    wire = await Wire.over(channel)
    try:
        begin = await _begin(wire)
        if begin is None:
            return 0
        store = await asyncio.to_thread(Store.open, begin.store_url)
        try:
            return await _serve(wire, begin, store, listening)
        finally:
            await asyncio.to_thread(store.close)
    except AbbeError as error:
        log.error("the web process cannot serve", code=error.code, cause=str(error))
        return 1
    finally:
        wire.close()


async def _begin(wire: Wire) -> Begin | None:
    """First message of the core; None: the core has ended."""
    body = await wire.receive()
    if body is None:
        return None
    first = from_core(body)
    if not isinstance(first, Begin) or first.protocol != PROTOCOL:
        raise ChannelBroken("the core of the service uses another version of the channel protocol")
    return first


async def _serve(wire: Wire, begin: Begin, store: Store, listening: socket.socket) -> int:
    clock = SystemClock()
    people = UserAccounts(store, clock)
    people.passwords.prepare()
    core = CoreLine(wire, clock)
    reader = Reader(store, begin.machine, clock, begin.control)
    view = StatusReader(reader, begin.version, core, core.next_due, begin.broker)
    auth = Authenticator(store, people, AuditBook(store, begin.store_url), Endpoint(begin.port, begin.behind_tls))
    plans = Rehearsals(begin.plan, begin.recipes, rules=begin.rules)
    parts = Parts(core, store, begin.machine, begin.recipes, plans, begin.campaigns, begin.control, begin.pushes_itself)
    plant = Gatherer(view.status, store, begin.control)
    api = Sources(
        reader=reader,
        schedules=begin.schedules,
        devices=lambda: core.devices,
        rules=begin.rules,
        tail=capture_log(),
        stated=begin.stated,
    )
    app = create_app(view, version=begin.version, hosts=begin.hosts, auth=auth, parts=parts, plant=plant, api=api)
    server = make_server(app, begin.certificate, begin.key)
    app.state.end = lambda: setattr(server, "should_exit", True)
    listening_to_core = asyncio.create_task(core.listen(), name="core")
    serving = asyncio.create_task(server.serve(sockets=[listening]), name="server")
    alive = asyncio.create_task(_send_heartbeats(wire, server), name="alive")
    await asyncio.wait({listening_to_core, serving, alive}, return_when=asyncio.FIRST_COMPLETED)
    server.should_exit = True
    core.end()
    await asyncio.wait({serving})
    alive.cancel()
    listening_to_core.cancel()
    await asyncio.wait({alive, listening_to_core})
    for task in (serving, listening_to_core, alive):
        if not task.cancelled():
            task.result()
    return 0


async def _send_heartbeats(wire: Wire, server: Server) -> None:
    await server.answers.wait()
    wire.send(Serving("up", PROTOCOL))
    while True:
        await asyncio.sleep(ALIVE_S)
        wire.send(WebHeartbeat("alive"))
