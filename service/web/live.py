"""WebSockets that send status and readings as they change. The middleware checks session and Origin before they open."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable
from contextlib import suppress

from fastapi import FastAPI, WebSocket, WebSocketDisconnect
from pydantic import TypeAdapter

from abbe.service.errors import CoreSilent
from abbe.service.queries.status import LiveEvent
from abbe.service.users.roles import Permission
from abbe.service.web.core_link.core_line import CoreLine
from abbe.service.web.login.access import needs
from abbe.service.web.login.auth_middleware import Visit

_EVENT = TypeAdapter(LiveEvent)
LONGEST_S = 600.0
"""Then it is closed: who listens on comes again, and is looked at again - a session that has ended in between hears no more."""
TRY_AGAIN, GOING_AWAY, POLICY = 1013, 1001, 1008


def add_live(app: FastAPI, core: CoreLine) -> None:
    """Add the live channels to the application."""

    @app.websocket("/api/v1/live")
    @needs(Permission.READ)
    async def live(socket: WebSocket) -> None:
        with core.listener(_who(socket)) as moments:
            if moments is None:
                await socket.close(TRY_AGAIN)
                return
            await socket.accept()

            async def tell() -> None:
                async for moment in moments():
                    text = _event(core, moment.changes)
                    if text is not None:
                        await socket.send_text(text)

            await _until_gone(socket, tell())

    @app.websocket("/api/v1/live/samples")
    @needs(Permission.READ)
    async def samples(socket: WebSocket) -> None:
        with core.samples.listener(_who(socket)) as parts:
            if parts is None:
                await socket.close(TRY_AGAIN)
                return
            await socket.accept()

            async def tell() -> None:
                async for part in parts():
                    await (socket.send_text(part) if isinstance(part, str) else socket.send_bytes(part))

            await _until_gone(socket, tell())


def _who(socket: WebSocket) -> str:
    visit: Visit = socket.state.visit
    return visit.principal.name


async def _until_gone(socket: WebSocket, telling: Awaitable[None]) -> None:
    """Tell until the client goes, says something, has listened long enough, or there is no more to tell; then close."""
    told = asyncio.ensure_future(telling)
    heard = asyncio.create_task(_gone(socket), name="live hear")
    try:
        await asyncio.wait({told, heard}, timeout=LONGEST_S, return_when=asyncio.FIRST_COMPLETED)
    finally:
        gone = heard.done()
        for task in (told, heard):
            task.cancel()
        await asyncio.gather(told, heard, return_exceptions=True)
    if gone and heard.result():
        return
    with suppress(RuntimeError, WebSocketDisconnect):  # it may have gone meanwhile
        await socket.close(POLICY if gone else GOING_AWAY)


async def _gone(socket: WebSocket) -> bool:
    """Wait until the client goes; False: it says something instead, which it has no reason to."""
    message = await socket.receive()
    return bool(message["type"] == "websocket.disconnect")


def _event(core: CoreLine, revision: int) -> str | None:
    """The event of this moment; None while the core is silent."""
    try:
        event = LiveEvent(
            revision=revision, job=core.job, devices=core.devices, mqtt_connected=core.mqtt_connected, attention=core.attention
        )
    except CoreSilent:
        return None
    return _EVENT.dump_json(event).decode()
