"""WebSockets that send status and readings as they change. The middleware checks session and Origin before they open."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable
from contextlib import suppress
from dataclasses import replace

from fastapi import FastAPI, WebSocket, WebSocketDisconnect
from pydantic import TypeAdapter

from abbe.service.domain.people import Permission
from abbe.service.domain.progress import RunningCheck
from abbe.service.errors import CoreUnavailable
from abbe.service.queries.status import LiveEvent
from abbe.service.rendering.phrases import phrase
from abbe.service.web.core_link.core_line import CoreLine
from abbe.service.web.frame import language_of
from abbe.service.web.login.access import needs
from abbe.service.web.login.auth_middleware import Visit

_EVENT = TypeAdapter(LiveEvent)
LONGEST_S = 600.0
"""Longest life of a connection. The client reconnects and is checked again, so an ended session gets no more events."""
TRY_AGAIN, GOING_AWAY, POLICY = 1013, 1001, 1008


def add_live(app: FastAPI, core: CoreLine) -> None:
    """Add the live channels to the application."""

    @app.websocket("/api/v1/live")
    @needs(Permission.READ)
    async def live(socket: WebSocket) -> None:
        with core.listener(_who(socket)) as snapshots:
            if snapshots is None:
                await socket.close(TRY_AGAIN)
                return
            await socket.accept()
            lang = language_of(socket)

            async def send_events() -> None:
                async for snapshot in snapshots():
                    text = _event(core, snapshot.changes, lang)
                    if text is not None:
                        await socket.send_text(text)

            await _until_closed(socket, send_events())

    @app.websocket("/api/v1/live/samples")
    @needs(Permission.READ)
    async def samples(socket: WebSocket) -> None:
        with core.samples.listener(_who(socket)) as parts:
            if parts is None:
                await socket.close(TRY_AGAIN)
                return
            await socket.accept()

            async def send_parts() -> None:
                async for part in parts():
                    await (socket.send_text(part) if isinstance(part, str) else socket.send_bytes(part))

            await _until_closed(socket, send_parts())


def _who(socket: WebSocket) -> str:
    visit: Visit = socket.state.visit
    return visit.principal.name


async def _until_closed(socket: WebSocket, work: Awaitable[None]) -> None:
    """Send until the client leaves or sends something, the work ends, or `LONGEST_S` has passed; then close."""
    sending = asyncio.ensure_future(work)
    receiving = asyncio.create_task(_disconnected(socket), name="live receive")
    try:
        await asyncio.wait({sending, receiving}, timeout=LONGEST_S, return_when=asyncio.FIRST_COMPLETED)
    finally:
        received = receiving.done()
        for task in (sending, receiving):
            task.cancel()
        await asyncio.gather(sending, receiving, return_exceptions=True)
    if received and receiving.result():
        return
    with suppress(RuntimeError, WebSocketDisconnect):  # the client may have left meanwhile
        await socket.close(POLICY if received else GOING_AWAY)


async def _disconnected(socket: WebSocket) -> bool:
    """Wait until the client disconnects; False: it sent a message, which the protocol does not allow."""
    message = await socket.receive()
    return bool(message["type"] == "websocket.disconnect")


def _event(core: CoreLine, revision: int, lang: str) -> str | None:
    """The current event as JSON, sentences in the reader's language; None while the core is silent."""
    try:
        attention = [phrase(lang, text) for text in core.attention]
        job = told(core.job, lang)
        event = LiveEvent(revision=revision, job=job, devices=core.devices, mqtt_connected=core.mqtt_connected, attention=attention)
    except CoreUnavailable:
        return None
    return _EVENT.dump_json(event).decode()


def told(job: RunningCheck | None, lang: str) -> RunningCheck | None:
    """The running check with its sentences in a language."""
    if job is None:
        return None
    return replace(job, ask=phrase(lang, job.ask), message=phrase(lang, job.message), why=phrase(lang, job.why))
