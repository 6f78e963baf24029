"""Where the OPC UA server listens and who may read. Knows nothing of asyncua, so that a machine file is checked without it."""

from __future__ import annotations

import importlib.util
import ipaddress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from abbe.service.errors import ConfigError


@dataclass(frozen=True, slots=True)
class OpcUaSetup:
    """What ``[opcua]`` of the machine file says.

    Parameters
    ----------
    host, port : str, int
        Where to listen; port 0: any.
    certificate, key : str
        PEM files; empty: no encryption, and this computer only.
    clients : tuple of str
        Certificates of those who may read, PEM or DER files. Empty: everybody on this computer, nobody else.
    """

    host: str = "127.0.0.1"
    port: int = 4840
    certificate: str = ""
    key: str = ""
    clients: tuple[str, ...] = ()

    @property
    def exposed(self) -> bool:
        """Whether other computers can reach it: then encryption, and a certificate known here, are demanded of everybody."""
        try:
            return not ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host != "localhost"

    @property
    def guarded(self) -> bool:
        """Whether only those with a known certificate may read."""
        return self.exposed or bool(self.clients)

    def check(self) -> None:
        """Refuse what cannot work or must not be.

        Raises
        ------
        ConfigError
            It would listen for other computers in clear, or to everybody; a certificate cannot be read; the extra is not installed.
        """
        if self.guarded and not (self.certificate and self.clients):
            raise ConfigError(
                f"[opcua] host {self.host!r} needs certificate, key and clients: others must be known, and be talked to encrypted",
                "give them, or use 127.0.0.1 without clients",
            )
        trusted(self.clients)
        for name in (self.certificate, self.key):
            if name and not Path(name).is_file():
                raise ConfigError(f"[opcua] {name}: no such file", "give a PEM certificate and its key")
        if importlib.util.find_spec("asyncua") is None:
            raise ConfigError("[opcua] needs the package 'asyncua'", "pip install 'abbe[opcua]', or set enabled = false")


def trusted(files: tuple[str, ...]) -> dict[bytes, x509.Certificate]:
    """Return the certificates of files, by their DER bytes.

    Raises
    ------
    ConfigError
        One cannot be read, or is no certificate.
    """
    found = {}
    for name in files:
        try:
            data = Path(name).read_bytes()
            read = x509.load_pem_x509_certificate if data.lstrip().startswith(b"-----") else x509.load_der_x509_certificate
            certificate = read(data)
        except OSError as trouble:
            raise ConfigError(f"[opcua] clients: {name}: {trouble.strerror}", "give certificates, PEM or DER") from None
        except ValueError:
            raise ConfigError(f"[opcua] clients: {name}: is no certificate", "give certificates, PEM or DER") from None
        found[certificate.public_bytes(Encoding.DER)] = certificate
    return found


def in_force(certificate: x509.Certificate, now: datetime | None = None) -> bool:
    """Tell whether a certificate is within its days."""
    return certificate.not_valid_before_utc <= (now or datetime.now(UTC)) <= certificate.not_valid_after_utc
