"""The web server inside our own event loop: our socket, our signals, our end."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Iterator
from contextlib import contextmanager

import uvicorn
from fastapi import FastAPI

from service.errors import ConfigError


class Server(uvicorn.Server):
    """uvicorn that leaves the signals alone: the service stops its parts in its own order."""

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Capture none."""
        yield


def make_server(app: FastAPI) -> Server:
    """Return a server for ``app``; run it with ``await server.serve(sockets=[bind(...)])``, end it with ``should_exit``."""
    return Server(
        uvicorn.Config(
            app,
            log_config=None,
            access_log=False,
            lifespan="off",
            http="h11",
            ws="none",
            server_header=False,
            proxy_headers=False,
            timeout_keep_alive=5,
            timeout_graceful_shutdown=1,
            limit_concurrency=100,
        )
    )


def bind(host: str, port: int) -> socket.socket:
    """Return a listening socket on a loopback address.

    Raises
    ------
    ConfigError
        The address is not a loopback address (the page has no login), or somebody else has the port.
    """
    if not _is_loopback(host):
        raise ConfigError(
            f"[web] host {host!r} can be reached from other computers, and the page has no login",
            "use 127.0.0.1, and an SSH tunnel or a reverse proxy with a login in front of it",
        )
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=64)
    except OSError as trouble:
        raise ConfigError(
            f"[web] cannot listen on {host} port {port}: {trouble.strerror}", "is another service running? choose another with --port"
        ) from trouble


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
