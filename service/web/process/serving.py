"""The web process put together: channel, store, users, application, server; and its end when the core has ended."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict

import structlog
import uvicorn
from fastapi import FastAPI

from abbe.service.audit.book import AuditBook
from abbe.service.channel.messages import PROTOCOL, Alive, Begin, Up, from_core
from abbe.service.channel.wire import Wire
from abbe.service.clock import SystemClock
from abbe.service.errors import AbbeError, ChannelBroken
from abbe.service.plant.gather import Gatherer
from abbe.service.queries.reader import Reader
from abbe.service.queries.status import StatusReader
from abbe.service.report.report_parts import Rules
from abbe.service.storage.store import Store
from abbe.service.users.people import People
from abbe.service.web.api.sources import Sources
from abbe.service.web.app import Parts, create_app
from abbe.service.web.core_link.core_line import CoreLine
from abbe.service.web.core_link.logtail import keep_log
from abbe.service.web.login.authentication import Authenticator, Front
from abbe.service.web.login.connections import PatientProtocol
from abbe.service.web.pages.rehearsal import Rehearsals

# The web server inside the event loop of the web process: the core's socket, our signals, our end.


HANDSHAKE_S = 10.0
LONGEST_WORD_B = 1024
"""A client of a WebSocket has nothing to say; what is longer ends the connection."""


class Server(uvicorn.Server):
    """uvicorn that leaves the signals alone: the service stops its parts in its own order. ``answers`` is set when it serves."""

    def __init__(self, config: uvicorn.Config) -> None:
        super().__init__(config)
        self.answers = asyncio.Event()

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Capture none."""
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to answer, and say so."""
        await self._listen(sockets)
        self.answers.set()

    async def _listen(self, sockets: list[socket.socket] | None) -> None:
        """Begin to listen. A visitor who never ends his TLS handshake is let go sooner than after asyncio's minute."""
        if self.config.ssl is None or sockets is None:
            await super().startup(sockets)
            return
        await super().startup([])  # all but the listening: uvicorn has no setting for how long a handshake may take

        def protocol() -> asyncio.Protocol:
            return PatientProtocol(config=self.config, server_state=self.server_state, app_state=self.lifespan.state)

        loop, tls = asyncio.get_running_loop(), self.config.ssl
        for listening in sockets:
            self.servers.append(await loop.create_server(protocol, sock=listening, ssl=tls, ssl_handshake_timeout=HANDSHAKE_S))


def make_server(app: FastAPI, certificate: str = "", key: str = "") -> Server:
    """Return a server for ``app``; run it with ``await server.serve(sockets=[...])``, end it with ``should_exit``.

    Parameters
    ----------
    app : FastAPI
        What it serves.
    certificate, key : str
        PEM files, checked before (`check_certificate`); empty: plain HTTP. Python's own settings refuse TLS below 1.2.
    """
    return Server(
        uvicorn.Config(
            app,
            ssl_certfile=certificate or None,
            ssl_keyfile=key or None,
            log_config=None,
            access_log=False,
            lifespan="off",
            http=PatientProtocol,
            ws="websockets-sansio",
            ws_max_size=LONGEST_WORD_B,
            ws_ping_interval=20.0,
            ws_ping_timeout=20.0,
            ws_per_message_deflate=False,
            server_header=False,
            proxy_headers=False,
            timeout_keep_alive=5,
            timeout_graceful_shutdown=1,
            # How many are connected and at work at the same time is the protocol's business: uvicorn counts who says nothing, too.
            limit_concurrency=None,
        )
    )


log = structlog.get_logger("abbe.web")

ALIVE_S = 2.0


async def serve_pages(channel: socket.socket, listening: socket.socket) -> int:
    """Serve until the channel ends; return the exit code. What is wrong is one line in the log: the core starts a new process."""
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
    """What the core says first; None: it has ended before."""
    body = await wire.receive()
    if body is None:
        return None
    first = from_core(body)
    if not isinstance(first, Begin) or first.protocol != PROTOCOL:
        raise ChannelBroken("the core of the service speaks another version of the channel")
    return first


async def _serve(wire: Wire, begin: Begin, store: Store, listening: socket.socket) -> int:
    clock = SystemClock()
    people = People(store, clock)
    people.passwords.prepare()
    core = CoreLine(wire, clock)
    reader = Reader(store, begin.machine, clock, begin.control)
    view = StatusReader(reader, begin.version, core, core.next_due, begin.broker)
    auth = Authenticator(store, people, AuditBook(store, begin.store_url), Front(begin.port, begin.behind_tls))
    parts = Parts(
        core, store, begin.machine, begin.recipes, Rehearsals(begin.plan, begin.recipes, rules=begin.rules), begin.campaigns, begin.control
    )
    plant = Gatherer(view.status, store, begin.control)
    api = Sources(
        reader=reader,
        schedules=begin.schedules,
        devices=lambda: core.devices,
        rules=Rules(**asdict(begin.rules)),
        tail=keep_log(),
    )
    app = create_app(view, version=begin.version, hosts=begin.hosts, auth=auth, parts=parts, plant=plant, api=api)
    server = make_server(app, begin.certificate, begin.key)
    app.state.end = lambda: setattr(server, "should_exit", True)
    heard = asyncio.create_task(core.listen(), name="core")
    serving = asyncio.create_task(server.serve(sockets=[listening]), name="server")
    alive = asyncio.create_task(_alive(wire, server), name="alive")
    await asyncio.wait({heard, serving, alive}, return_when=asyncio.FIRST_COMPLETED)
    server.should_exit = True
    core.end()
    await asyncio.wait({serving})
    alive.cancel()
    heard.cancel()
    await asyncio.wait({alive, heard})
    for task in (serving, heard, alive):
        if not task.cancelled():
            task.result()
    return 0


async def _alive(wire: Wire, server: Server) -> None:
    await server.answers.wait()
    wire.send(Up("up", PROTOCOL))
    while True:
        await asyncio.sleep(ALIVE_S)
        wire.send(Alive("alive"))
