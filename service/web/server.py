"""The web server inside our own event loop: our socket, our signals, our end."""

from __future__ import annotations

import ipaddress
import socket
import ssl
from collections.abc import Callable, Iterator
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


def make_server(app: FastAPI, certificate: str = "", key: str = "") -> Server:
    """Return a server for ``app``; run it with ``await server.serve(sockets=[bind(...)])``, end it with ``should_exit``.

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
            http="h11",
            ws="none",
            server_header=False,
            proxy_headers=False,
            timeout_keep_alive=5,
            timeout_graceful_shutdown=1,
            limit_concurrency=100,
        )
    )


def check_certificate(certificate: str, key: str) -> None:
    """Refuse a certificate that cannot be used; nothing happens without one.

    Raises
    ------
    ConfigError
        Certificate or key cannot be read, or do not belong together.
    """
    if not certificate:
        return
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key, password="")
    except OSError as trouble:  # ssl.SSLError is one
        why = trouble.strerror or str(trouble)
        raise ConfigError(f"[web] certificate {certificate}, key {key}: {why}", "give a PEM certificate and its key") from None


def check_exposure(host: str, users: Callable[[], int], *, tls: bool) -> None:
    """Refuse to be reached from other computers without users and encryption.

    Parameters
    ----------
    host : str
        Address to listen on.
    users : callable
        How many may log in; asked only if it matters.
    tls : bool
        Whether a certificate is configured.

    Raises
    ------
    ConfigError
        What is missing.
    """
    if is_loopback(host):
        return
    if users() == 0:
        raise ConfigError(
            f"[web] host {host!r} can be reached from other computers, and there is no user",
            "add one first (abbe user add NAME admin), or use 127.0.0.1",
        )
    if not tls:
        raise ConfigError(
            f"[web] host {host!r} can be reached from other computers, and passwords would cross the network in clear",
            "give certificate and key under [web], or use 127.0.0.1 behind a reverse proxy with TLS",
        )


def bind(host: str, port: int) -> socket.socket:
    """Return a listening socket. Whether it may listen there is `check_exposure`'s to say, before.

    Raises
    ------
    ConfigError
        Somebody else has the port, or the address is not this computer's.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=64)
    except OSError as trouble:
        raise ConfigError(
            f"[web] cannot listen on {host} port {port}: {trouble.strerror}", "is another service running? choose another with --port"
        ) from trouble


def is_loopback(host: str) -> bool:
    """Tell whether an address can be reached from this computer only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
