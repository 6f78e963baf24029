"""The address of the MQTT broker, and the topics of one machine.

Address: ``mqtt://host:port`` or ``mqtts://host:port``, with ``user:password@`` before the host if the broker requires it. Only messages of
the topic ``{prefix}/{machine}/state`` are retained.
"""

from __future__ import annotations

import ssl
from dataclasses import astuple, dataclass
from urllib.parse import unquote, urlsplit

from abbe.service.errors import ConfigError


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """PEM files of an encrypted connection.

    ``ca``: certificate of the authority that signed the broker's certificate; empty: the authorities that this computer trusts.
    ``certificate``, ``key``: the client's, if the broker requires them.
    """

    ca: str = ""
    certificate: str = ""
    key: str = ""


@dataclass(frozen=True, slots=True)
class Broker:
    """Address of a broker.

    Parameters
    ----------
    tls : bool
        Whether to encrypt, and to check the broker's certificate.
    username : str or None
        User name, if the broker requires one.
    password : str or None
        Never shown in a ``repr`` or in an error.
    """

    host: str
    port: int
    tls: bool = False
    username: str | None = None
    password: str | None = None
    files: TlsFiles = TlsFiles()

    def __repr__(self) -> str:
        return f"Broker({self})"

    def __str__(self) -> str:
        return f"{'mqtts' if self.tls else 'mqtt'}://{self.host}:{self.port}"

    def tls_context(self) -> ssl.SSLContext | None:
        """Return the TLS context that checks the broker: authority, host name, TLS 1.2 or newer. None without TLS.

        Raises
        ------
        ConfigError
            A file cannot be read or has the wrong content.
        """
        if not self.tls:
            return None
        try:
            context = ssl.create_default_context(cafile=self.files.ca or None)
            context.minimum_version = ssl.TLSVersion.TLSv1_2
            if self.files.certificate:
                context.load_cert_chain(self.files.certificate, self.files.key, password="")
        except OSError as trouble:  # ssl.SSLError is one
            why = trouble.strerror or str(trouble)
            files = ", ".join(name for name in astuple(self.files) if name)
            raise ConfigError(
                f"[mqtt] ca, certificate, key ({files}): {why}", "give PEM files; certificate and key belong together"
            ) from None
        return context


def parse(url: str) -> Broker:
    """Return the broker of a URL.

    Raises
    ------
    ConfigError
        The URL is not the address of a broker.
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


_LEVEL = 100
_FORBIDDEN = "+#\0"


@dataclass(frozen=True, slots=True)
class Topics:
    """Topics of one machine's messages.

    Parameters
    ----------
    prefix : str
        One or more levels, for example ``plant/abbe``.
    machine : str
        Name of the machine; becomes one level, see `level`.
    """

    prefix: str
    machine: str

    def __post_init__(self) -> None:
        if not self.prefix or self.prefix.startswith(("/", "$")) or self.prefix.endswith("/") or set(self.prefix) & set(_FORBIDDEN):
            raise ConfigError(
                f"[mqtt] topic_prefix {self.prefix!r} cannot be part of a topic", "use levels such as plant/abbe, without + # or $"
            )

    @property
    def state(self) -> str:
        """Topic of the retained state: online, measuring or offline. If the service vanishes, the broker publishes offline (last will)."""
        return f"{self.prefix}/{level(self.machine)}/state"

    @property
    def verification(self) -> str:
        """Topic with one message for every check."""
        return f"{self.prefix}/{level(self.machine)}/verification"

    @property
    def alarm(self) -> str:
        """Topic with one message for each event that a person should look at."""
        return f"{self.prefix}/{level(self.machine)}/alarm"


def level(name: str) -> str:
    """Return ``name`` as one topic level: letters, digits, ``-``, ``_`` and ``.`` stay, everything else becomes ``_``."""
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in name)[:_LEVEL] or "_"


def client_id(machine: str) -> str:
    """Return the client identifier, always the same for a machine.

    After a crash the broker must replace the old connection by the new one; otherwise the old one's last will would publish offline while
    the new one is connected.
    """
    return f"abbe-{level(machine)}"
