"""The listening socket, its certificate, and whether other computers may reach it. The core checks all three when it starts."""

from __future__ import annotations

import ipaddress
import socket
import ssl
from collections.abc import Callable, Sequence

from abbe.service.errors import ConfigError


def check_certificate(certificate: str, key: str) -> None:
    """Check that a certificate is usable; an empty path passes.

    Raises
    ------
    ConfigError
        Certificate or key is unreadable, or they do not match.
    """
    if not certificate:
        return
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key, password="")
    except OSError as trouble:  # ssl.SSLError is one
        why = trouble.strerror or str(trouble)
        raise ConfigError(f"[web] certificate {certificate}, key {key}: {why}", "give a PEM certificate and its key") from None


def check_exposure(host: str, admins: Callable[[], int], *, tls: bool, names: Sequence[str] = (), behind_tls: bool = False) -> None:
    """Refuse to serve other computers unless there is an admin and the connection is encrypted.

    Parameters
    ----------
    host : str
        Address to listen on.
    admins : callable
        Number of admins who have a password and can log in; called only if needed. Other users do not count: they cannot manage access.
    tls : bool
        Whether a certificate is configured.
    names : sequence of str
        Host names by which other computers reach the service; through a reverse proxy if ``host`` is a loopback address.
    behind_tls : bool
        Whether that proxy terminates TLS.

    Raises
    ------
    ConfigError
        An admin or encryption is missing.
    """
    wide, proxied = not is_loopback(host), [name for name in names if not is_loopback(name.removeprefix("[").removesuffix("]"))]
    if not wide and not proxied:
        return
    what = f"[web] host {host!r} can be reached" if wide else f"[web] names {', '.join(map(repr, proxied))} can be reached"
    if admins() == 0:
        raise ConfigError(
            f"{what} from other computers, and there is no user who is admin, has a password and may log in",
            "add one first (abbe user add NAME admin), or use 127.0.0.1" + ("" if wide else " without names"),
        )
    if not tls and (wide or not behind_tls):
        raise ConfigError(
            f"{what} from other computers, and passwords would cross the network in clear",
            "give certificate and key under [web], or use 127.0.0.1 and behind_tls = true behind a reverse proxy with TLS",
        )


def bind(host: str, port: int) -> socket.socket:
    """A listening socket; call `check_exposure` first.

    Raises
    ------
    ConfigError
        The port is in use, or the address is not this computer's.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listening = socket.create_server((host, port), family=family, backlog=64)
        # Connections inherit this option. Without it, head and body would wait 40 ms for each other: asyncio does not set it here.
        listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return listening
    except OSError as trouble:
        raise ConfigError(
            f"[web] cannot listen on {host} port {port}: {trouble.strerror}",
            "stop the other service, or choose another port with --port",
        ) from trouble


def is_loopback(host: str) -> bool:
    """Whether only this computer can reach an address."""
    return host == "localhost" or is_local(host)


def is_local(address: str) -> bool:
    """Whether an address is this computer's own."""
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return False
