"""Certificates for tests: an authority, and what it signs."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID


@dataclass(frozen=True)
class Signed:
    """A certificate with its key, and the PEM files of both."""

    certificate: x509.Certificate
    key: rsa.RSAPrivateKey
    pem: Path
    key_pem: Path


def authority(folder: Path, name: str) -> Signed:
    return _made(folder, name, None, (), ca=True, days=(-1, 30))


def issued(
    folder: Path, name: str, by: Signed | None, *, addresses: tuple[str, ...] = (), uri: str = "", days: tuple[int, int] = (-1, 30)
) -> Signed:
    """``by`` None: self-signed, as OPC UA programs do it."""
    names: list[x509.GeneralName] = [
        x509.IPAddress(ipaddress.ip_address(one)) if one[:1].isdigit() else x509.DNSName(one) for one in addresses
    ]
    if uri:
        names.append(x509.UniformResourceIdentifier(uri))
    return _made(folder, name, by, tuple(names), ca=False, days=days)


def _made(folder: Path, name: str, by: Signed | None, names: tuple[x509.GeneralName, ...], *, ca: bool, days: tuple[int, int]) -> Signed:
    key = rsa.generate_private_key(65537, 2048)
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now = datetime.now(UTC)
    build = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(by.certificate.subject if by else subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now + timedelta(days=days[0]))
        .not_valid_after(now + timedelta(days=days[1]))
        .add_extension(x509.BasicConstraints(ca, None), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )
    if names:
        build = build.add_extension(x509.SubjectAlternativeName(names), critical=False)
    if ca:
        usage = x509.KeyUsage(False, False, False, False, False, True, True, False, False)
    else:
        usage = x509.KeyUsage(True, True, True, True, False, by is None, False, False, False)
        both = x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH])
        build = build.add_extension(both, critical=False)
    build = build.add_extension(usage, critical=True)
    if by is not None:
        build = build.add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(by.key.public_key()), critical=False)
    certificate = build.sign(by.key if by else key, hashes.SHA256())
    pem, key_pem = folder / f"{name}.pem", folder / f"{name}.key.pem"
    pem.write_bytes(certificate.public_bytes(Encoding.PEM))
    key_pem.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    return Signed(certificate, key, pem, key_pem)
