"""Check the OPC UA section of the machine file. This module does not need asyncua."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from abbe.service.config_schema import OpcUa
from abbe.service.errors import ConfigError


def check_opcua(setup: OpcUa) -> None:
    """Refuse an impossible or unsafe setup.

    Raises
    ------
    ConfigError
        Other computers could connect without encryption or a known certificate; clients cannot be recognised, as nothing is encrypted; a
        certificate cannot be read; asyncua is not installed.
    """
    if setup.guarded and not (setup.certificate and setup.clients):
        if setup.exposed:
            raise ConfigError(
                f"[opcua] host {setup.host!r} can be reached by other computers: it needs certificate, key and clients",
                "give all three, or use 127.0.0.1 without clients",
            )
        raise ConfigError(
            "[opcua] clients needs certificate and key: a client is recognised only on an encrypted connection",
            "give certificate and key, or leave clients out",
        )
    trusted(setup.clients)
    for name in (setup.certificate, setup.key):
        if name and not Path(name).is_file():
            raise ConfigError(f"[opcua] {name}: no such file", "give a PEM certificate and its key")
    if importlib.util.find_spec("asyncua") is None:
        raise ConfigError("[opcua] needs the package 'asyncua'", "pip install 'abbe[opcua]', or set enabled = false")


def trusted(files: Sequence[str]) -> dict[bytes, x509.Certificate]:
    """Read certificate files; return the certificates by their DER bytes.

    Raises
    ------
    ConfigError
        A file cannot be read, or is not a certificate.
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
            raise ConfigError(f"[opcua] clients: {name}: is not a certificate", "give certificates, PEM or DER") from None
        found[certificate.public_bytes(Encoding.DER)] = certificate
    return found


def in_force(certificate: x509.Certificate, now: datetime | None = None) -> bool:
    """Return whether a certificate is valid now."""
    return certificate.not_valid_before_utc <= (now or datetime.now(UTC)) <= certificate.not_valid_after_utc
