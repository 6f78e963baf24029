"""The web process put together: channel, store, users, application, server; and its end when the core has ended."""

from __future__ import annotations

import asyncio
import socket
from dataclasses import asdict

import structlog

from abbe.service.audit.book import AuditBook
from abbe.service.channel.messages import PROTOCOL, Alive, Begin, Up, from_core
from abbe.service.channel.wire import Wire
from abbe.service.clock import SystemClock
from abbe.service.errors import AbbeError, ChannelBroken
from abbe.service.plant.gather import Gatherer
from abbe.service.report.report_parts import Rules
from abbe.service.scheduler.slots import Needs, Schedule
from abbe.service.scheduler.store import ServiceStore
from abbe.service.users.people import People
from abbe.service.web.api.sources import Sources
from abbe.service.web.app import Parts, create_app
from abbe.service.web.core_link.core_line import CoreLine
from abbe.service.web.core_link.logtail import keep_log
from abbe.service.web.login.authentication import Door, Front
from abbe.service.web.pages.rehearsal import Rehearsals
from abbe.service.web.process.server import Server, make_server
from abbe.service.web.view import View

log = structlog.get_logger("abbe.web")

ALIVE_S = 2.0


async def serve_pages(channel: socket.socket, listening: socket.socket) -> int:
    """Serve until the channel ends; return the exit code. What is wrong is one line in the log: the core starts a new process."""
    wire = await Wire.over(channel)
    try:
        begin = await _begin(wire)
        if begin is None:
            return 0
        store = await asyncio.to_thread(ServiceStore.open, begin.store_url)
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


async def _serve(wire: Wire, begin: Begin, store: ServiceStore, listening: socket.socket) -> int:
    clock = SystemClock()
    people = People(store, clock)
    people.passwords.prepare()
    core = CoreLine(wire, clock)
    view = View(begin.machine, begin.version, core, store, core.next_due, begin.broker, clock, begin.control)
    door = Door(store, people, AuditBook(store, begin.store_url), Front(begin.port, begin.behind_tls))
    parts = Parts(
        core, store, begin.machine, begin.recipes, Rehearsals(begin.plan, begin.recipes, rules=begin.rules), begin.campaigns, begin.control
    )
    plant = Gatherer(view.status, store, begin.control)
    schedules = tuple(Schedule(**asdict(told) | {"needs": Needs(**asdict(told.needs))}) for told in begin.schedules)
    api = Sources(store, begin.machine, clock, schedules, lambda: core.devices, Rules(**asdict(begin.rules)), keep_log(), begin.control)
    app = create_app(view, version=begin.version, hosts=begin.hosts, door=door, parts=parts, plant=plant, api=api)
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
