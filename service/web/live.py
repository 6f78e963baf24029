"""How things stand, told as it changes, over a WebSocket. The guard has looked at session and Origin before it opens."""

from __future__ import annotations

import asyncio
from contextlib import suppress

from fastapi import FastAPI, WebSocket, WebSocketDisconnect

from service.errors import CoreSilent
from service.users.roles import Permission
from service.web.access import needs
from service.web.core_line import CoreLine
from service.web.schemas_jobs import Live

LONGEST_S = 600.0
"""Then it is closed: who listens on comes again, and is looked at again - a session that has ended in between hears no more."""
TRY_AGAIN, GOING_AWAY, POLICY = 1013, 1001, 1008


def add_live(app: FastAPI, core: CoreLine) -> None:
    """Add the live channel to the application."""

    @app.websocket("/api/v1/live")
    @needs(Permission.READ)
    async def live(socket: WebSocket) -> None:
        with core.listener() as moments:
            if moments is None:
                await socket.close(TRY_AGAIN)
                return
            await socket.accept()

            async def tell() -> None:
                async for moment in moments():
                    text = _event(core, moment.changes)
                    if text is not None:
                        await socket.send_text(text)

            told = asyncio.create_task(tell(), name="live tell")
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
        event = Live(revision=revision, job=core.job, devices=core.devices, mqtt_connected=core.mqtt_connected, attention=core.attention)
    except CoreSilent:
        return None
    return event.model_dump_json()
