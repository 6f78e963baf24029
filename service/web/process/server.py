"""The web server inside the event loop of the web process: the core's socket, our signals, our end."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Iterator
from contextlib import contextmanager

import uvicorn
from fastapi import FastAPI

from abbe.service.web.login.connections import PatientProtocol

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
        await super().startup([])  # all but the listening: uvicorn cannot be told how long a handshake may take

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
