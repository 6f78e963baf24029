"""Where the broker is: ``mqtt://host:port`` or ``mqtts://host:port``, with ``user:password@`` if the broker wants to know."""

from __future__ import annotations

import ssl
from dataclasses import dataclass
from urllib.parse import unquote, urlsplit

from service.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Broker:
    """Address of a broker.

    Parameters
    ----------
    host : str
        Name or address.
    port : int
        TCP port.
    tls : bool
        Whether to encrypt, and to check the broker's certificate.
    username : str or None
        User name, if the broker wants one.
    password : str or None
        Never shown in a ``repr`` or in an error.
    """

    host: str
    port: int
    tls: bool = False
    username: str | None = None
    password: str | None = None

    def __repr__(self) -> str:
        return f"Broker({self})"

    def __str__(self) -> str:
        return f"{'mqtts' if self.tls else 'mqtt'}://{self.host}:{self.port}"

    def tls_context(self) -> ssl.SSLContext | None:
        """Return the system's trust store as a context, or None without TLS."""
        return ssl.create_default_context() if self.tls else None


def parse(url: str) -> Broker:
    """Return the broker of a URL.

    Raises
    ------
    ConfigError
        The URL is not one of a broker.
    """
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError as wrong:
        raise ConfigError(f"[mqtt] url: {wrong}", "write mqtt://host:1883") from wrong
    if parts.scheme not in {"mqtt", "mqtts"} or not parts.hostname or parts.path not in {"", "/"}:
        raise ConfigError("[mqtt] url is not the address of a broker", "write mqtt://host:1883 or mqtts://host:8883")
    tls = parts.scheme == "mqtts"
    return Broker(
        parts.hostname,
        port or (8883 if tls else 1883),
        tls,
        unquote(parts.username) if parts.username else None,
        unquote(parts.password) if parts.password else None,
    )
